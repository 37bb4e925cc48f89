"""Times the feed-forward network with random weights: floating-point operations against time, and memory.

Every case runs in a process of its own, so that its peak memory is its own; rows that are compared with each other take
turns in one process.
"""

from __future__ import annotations

import dataclasses
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import bars
import numpy as np
import tyro
from network_cases import CASES, QUICK_CASES, QUICK_SLOTS, SLOT_CASES, Case, features_and_context, inputs_of
from render import PLAIN, machine_name, progress, write
from scenes import ROOT

from nurec_sim.cli.console import out

HEADING = (
    f"{'case':30s} {'images':>14s} {'M par':>6s} {'TFLOP':>7s} {'s':>7s} {'cpu s':>7s} {'first':>7s} {'GFLOP/s':>8s}"
    f" {'/cpu s':>7s} {'GB':>5s} {'Gaussians':>10s} {'load':>5s}"
)
SLOT_HEADING = (
    f"{'slots of the road branch':30s} {'road':>14s} {'tokens':>11s} {'TFLOP':>15s} {'decoder s':>15s} {'ratio':>6s}"
    f" {'whole pass':>10s}"
)
CaseName = Literal[tuple(CASES)]  # type: ignore[valid-type]
PrecisionName = Literal["float32", "bfloat16", "float16"]


@dataclass(frozen=True)
class Options:
    """Time the network, count its operations and memory, print a table and write build/bench_network.json.

    Examples: "python benchmarks/network.py --quick" takes half a minute; "python benchmarks/network.py --device cuda"
    measures a 20 s clip on a GPU.

    Args:
        cases: what to run.
        precisions: of matrix products and convolutions, each for every case.
        slots: also compare the road branch of the selective decoder with the release's rule.
        quick: only the small network, and few images.
        repeats: timed passes of each row, after one that warms up.
        threads: threads of torch; all that the process may use if not given.
        device: ``cpu``, or a CUDA device for the one case with a limit there.
        output: the results, as JSON.
        only: run one case here and print its rows as JSON; what the processes of the cases are called with.
    """

    cases: tuple[CaseName, ...] = tuple(name for name, case in CASES.items() if case.device == "cpu")
    precisions: tuple[PrecisionName, ...] = ("float32", "bfloat16")
    slots: bool = True
    quick: bool = False
    repeats: int = 3
    threads: int | None = None
    device: str = "cpu"
    output: Path = ROOT / "build" / "bench_network.json"
    only: str | None = None

    @property
    def thread_count(self) -> int:
        """Threads of torch."""
        return self.threads or len(os.sched_getaffinity(0))


def main() -> int:
    """Run what the command line asks for."""
    options = tyro.cli(Options)
    if options.only is not None:
        print(json.dumps(measured(options.only, options)))
        return 0
    if options.device != "cpu":
        reason = why_no_gpu(options.device)
        if reason is not None:
            out.print(f"nothing measured on {options.device}: {reason}", **PLAIN)
            return 0
        names = tuple(name for name, case in CASES.items() if case.device == "cuda")
        options = dataclasses.replace(options, cases=names, precisions=("bfloat16", "float16"), slots=False)
    if options.quick:
        options = dataclasses.replace(options, cases=QUICK_CASES, repeats=min(options.repeats, 2))
    load = os.getloadavg()[0]
    out.print(f"{machine_name()}, {options.thread_count} threads, load {load:.2f}, random weights", **PLAIN)
    rows: list[dict[str, Any]] = []
    for row in all_rows(options):
        rows.append({**row, "machine": machine_name()})
        write(rows, options.output)
    for line in verdicts(rows):
        out.print(line, **PLAIN)
    out.print(f"wrote {len(rows)} rows to {options.output}", **PLAIN)
    return 0


def all_rows(options: Options) -> Iterator[dict[str, Any]]:
    """Rows as they become known, each printed."""
    out.print(HEADING, **PLAIN)
    for name in options.cases:
        for precision in options.precisions:
            for row in in_process(f"{name} {precision}", options):
                out.print(line_of(row), **PLAIN)
                yield row
    if options.slots:
        out.print(SLOT_HEADING, **PLAIN)
        for name in QUICK_SLOTS if options.quick else SLOT_CASES:
            for row in in_process(f"{name} slots", options):
                out.print(slot_line_of(row), **PLAIN)
                yield row


def in_process(only: str, options: Options) -> list[dict[str, Any]]:
    """The rows of a case, run by a new process of this script."""
    command = [sys.executable, __file__, "--only", only, "--repeats", str(options.repeats)]
    command += ["--threads", str(options.thread_count), "--device", options.device]
    with progress(only) as advance:
        advance("in a process of its own", 0.5)
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
    if ran.returncode != 0:
        last = (ran.stderr.strip() or "no output").splitlines()[-1]
        out.print(f"{only} could not be measured: {last}", **PLAIN)
        return []
    return json.loads(ran.stdout.splitlines()[-1])


# ------------------------------------------------------------------------------------- in the process of a case


def measured(only: str, options: Options) -> list[dict[str, Any]]:
    """The rows of one case, measured here."""
    import torch

    torch.set_num_threads(options.thread_count)
    name, what = only.split()
    with torch.inference_mode():
        if what == "slots":
            return slot_rows(SLOT_CASES.get(name) or QUICK_SLOTS[name], options)
        return [pass_row(name, CASES.get(name) or QUICK_CASES[name], what, options)]


def pass_row(name: str, case: Case, precision: Any, options: Options) -> dict[str, Any]:
    """Whole passes of a case: all its chunks after each other."""
    import torch

    from nurec_sim import network

    model = network.build(case.profile, precision=precision).to(options.device)
    chunks = [inputs_of(case, seed).to(options.device) for seed in range(case.chunks)]
    outputs, operations = counted(lambda: model(chunks[0]))
    gaussians = case.chunks * outputs.gaussians.opacity.numel()
    del outputs
    times = [
        timed(lambda: [model(chunk) for chunk in chunks] and None, options.device) for _ in range(options.repeats + 1)
    ]
    row = {
        "name": f"{name} {precision}",
        "profile": case.profile,
        "precision": precision,
        "images": case.cameras * case.frames,
        "chunks": case.chunks,
        "width": chunks[0].rgb.shape[3],
        "height": chunks[0].rgb.shape[2],
        "device": options.device,
        "threads": options.thread_count,
        "parameters": sum(parameter.numel() for parameter in model.parameters()),
        "gaussians": gaussians,
        "tflop": case.chunks * operations / 1e12,
        "s_first": times[0][0],
        "s_median": float(np.median([wall for wall, _ in times[1:]])),
        "cpu_s_median": float(np.median([cpu for _, cpu in times[1:]])),
        "passes": options.repeats,
        # Kilobytes on Linux.
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9,
        "load_average": os.getloadavg()[0],
    }
    row["gflop_per_s"] = 1e3 * row["tflop"] / row["s_median"]
    row["gflop_per_cpu_s"] = 1e3 * row["tflop"] / row["cpu_s_median"]
    if options.device != "cpu":
        row["gpu"] = torch.cuda.get_device_name(options.device)
        row["peak_gpu_gb"] = torch.cuda.max_memory_allocated(options.device) / 1e9
    return row


def slot_rows(case: Case, options: Options) -> list[dict[str, Any]]:
    """The selective decoder at several shares of road, with our rule and the release's in turns."""
    from nurec_sim import network

    model = network.build(case.profile).to(options.device)
    inputs = inputs_of(case, 0).to(options.device)
    decoder, size = model.decoder, model.decoder.size
    whole_s = min(timed(lambda: model(inputs) and None, options.device)[0] for _ in range(2))
    rows = []
    for share in case.road_shares:
        features, context = features_and_context(model, inputs, share)
        tokens, operations = {}, {}
        seconds: dict[bool, list[float]] = {False: [], True: []}
        for number in range(options.repeats + 1):
            for fill in (False, True):
                decoder.fill_road_slots = fill
                decode = lambda features=features, context=context: decoder.gaussians(features, context, inputs)  # noqa: E731
                if number == 0:
                    gaussians, operations[fill] = counted(decode)
                    tokens[fill] = gaussians.opacity.numel() // size.cell**2
                else:
                    seconds[fill].append(timed(lambda decode=decode: decode() and None, options.device)[0])
        ours_s, theirs_s = (float(np.median(seconds[fill])) for fill in (False, True))
        rows.append(
            {
                "name": f"{case.profile} slots, {100 * share:.0f} % road",
                "profile": case.profile,
                "images": case.cameras * case.frames,
                "road_share": share,
                "threads": options.thread_count,
                "tokens": tokens[False],
                "tokens_release": tokens[True],
                "tflop": operations[False] / 1e12,
                "tflop_release": operations[True] / 1e12,
                "s_median": ours_s,
                "s_median_release": theirs_s,
                "ratio": ours_s / theirs_s,
                "s_whole_pass": whole_s,
                "passes": options.repeats,
                "load_average": os.getloadavg()[0],
            }
        )
    return rows


def counted(work: Callable[[], Any]) -> tuple[Any, int]:
    """The result of some work, and its floating-point operations in matrix products, convolutions and attention."""
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    def attention(query, key, value, *args, **kwargs) -> int:
        return 2 * query[0] * query[1] * query[2] * key[2] * (query[3] + value[3])

    # torch counts attention on GPUs only.
    on_cpu = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
    with FlopCounterMode(display=False, custom_mapping={on_cpu: attention}) as counter:
        result = work()
    return result, counter.get_total_flops()


def timed(work: Callable[[], Any], device: str) -> tuple[float, float]:
    """Wall and CPU seconds of some work, what it leaves to a GPU included."""
    import torch

    def wait() -> None:
        if device != "cpu":
            torch.cuda.synchronize(device)

    wait()
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    wait()
    return time.perf_counter() - wall, time.process_time() - cpu


def why_no_gpu(device: str) -> str | None:
    """Why nothing can run on a CUDA device, None if it can."""
    import torch

    if not torch.cuda.is_available():
        return "torch sees no CUDA device"
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        return str(error).splitlines()[0]
    return None


# -------------------------------------------------------------------------------------------------- what is printed


def verdicts(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """One line per limit whose rows were measured; times hold for two threads, in the fastest precision."""
    for name, case in CASES.items():
        own = [row for row in rows if row["name"].split()[0] == name and "precision" in row]
        if not own or case.limit_s is None:
            continue
        for row in own:
            yield bars.verdict(row["name"], row["s_median"], case.limit_s, "s")
            if case.limit_gb is not None:
                yield bars.verdict(f"peak of {row['name']}", row["peak_gb"], case.limit_gb, "GB")
    slots = [row for row in rows if "ratio" in row]
    if slots:
        best, worst = (pick(slots, key=lambda row: row["ratio"]) for pick in (min, max))
        yield bars.verdict(f"{best['name']}, over the release's rule", best["ratio"], 1.0, "x")
        yield f"        {worst['name']}, over the release's rule: {worst['ratio']:.4g} x (no slot is left over there)"


def line_of(row: dict[str, Any]) -> str:
    """A row of whole passes as one line of the table."""
    images = f"{row['images']} x {row['width']}x{row['height']}"
    return (
        f"{row['name']:30s} {images:>14s} {row['parameters'] / 1e6:6.1f} {row['tflop']:7.3f} {row['s_median']:7.2f}"
        f" {row['cpu_s_median']:7.2f} {row['s_first']:7.2f} {row['gflop_per_s']:8.0f} {row['gflop_per_cpu_s']:7.0f}"
        f" {row['peak_gb']:5.2f} {row['gaussians']:10,d} {row['load_average']:5.1f}"
    )


def slot_line_of(row: dict[str, Any]) -> str:
    """A comparison of the two rules as one line of the table; ours / the release's."""
    tokens = f"{row['tokens']}/{row['tokens_release']}"
    operations = f"{row['tflop']:.3f}/{row['tflop_release']:.3f}"
    seconds = f"{row['s_median']:.2f}/{row['s_median_release']:.2f}"
    return (
        f"{row['name']:30s} {100 * row['road_share']:12.0f} % {tokens:>11s} {operations:>15s} {seconds:>15s}"
        f" {row['ratio']:6.2f} {row['s_whole_pass']:10.2f}"
    )


if __name__ == "__main__":
    sys.exit(main())
