"""Times the feed-forward network with random weights: floating-point operations against time, and memory.

Every case has a process of its own, so that its peak memory is its own; what is compared takes turns in one process.
"""

from __future__ import annotations

import dataclasses
import json
import os
import resource
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import bars
import numpy as np
import tyro
from network_cases import CASES, QUICK_CASES, Case, Drive, features_and_context, inputs_of
from render import PLAIN, machine_name, progress, write
from scenes import ROOT

from nurec_sim.cli.console import out

CaseName = Literal[tuple(CASES)]  # type: ignore[valid-type]
PrecisionName = Literal["float32", "bfloat16", "float16"]
Row = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """Time the network, count its operations and memory, print tables and write build/bench_network.json.

    Weights are random and seeded. docs/benchmarks.md explains every column.

    Examples: "python benchmarks/network.py --quick" takes half a minute; "python benchmarks/network.py --device cuda"
    measures a 20 s clip on a GPU.

    Args:
        cases: what to run; all of the device if not given.
        precisions: of matrix products and convolutions, each for every pass.
        quick: only the small network, and few images.
        repeats: timed passes of each row, after the one that is counted.
        threads: threads of torch; all that the process may use if not given.
        device: ``cpu``, or a CUDA device.
        output: the results, as JSON.
        only: run one case here, in this precision, and print its rows as JSON; how a case's own process is called.
    """

    cases: tuple[CaseName, ...] = ()
    precisions: tuple[PrecisionName, ...] = ("float32", "bfloat16")
    quick: bool = False
    repeats: int = 3
    threads: int | None = None
    device: str = "cpu"
    output: Path = ROOT / "build" / "bench_network.json"
    only: tuple[str, str] | None = None

    @property
    def thread_count(self) -> int:
        """Threads of torch."""
        return self.threads or len(os.sched_getaffinity(0))


def main() -> int:
    """Run the benchmark."""
    options = tyro.cli(Options)
    if options.only is not None:
        print(json.dumps(measured(*options.only, options)))
        return 0
    reason = why_no_gpu(options.device)
    if reason is not None:
        out.print(f"nothing measured on {options.device}: {reason}", **PLAIN)
        return 0
    load = os.getloadavg()[0]
    out.print(f"{machine_name()}, {options.thread_count} threads, load {load:.2f}, random weights", **PLAIN)
    rows: list[Row] = []
    for row in all_rows(options):
        rows.append({**row, "machine": machine_name()})
        write(rows, options.output)
    for line in verdicts(rows):
        out.print(line, **PLAIN)
    out.print(f"wrote {len(rows)} rows to {options.output}", **PLAIN)
    return 0


def all_rows(options: Options) -> Iterator[Row]:
    """Rows as they become known, each printed."""
    kind = "cpu" if options.device == "cpu" else "cuda"
    chosen = QUICK_CASES if options.quick else CASES
    names = options.cases or [name for name, case in chosen.items() if case.device == kind]
    heading = ""
    for name in names:
        case = chosen[name]
        for precision in ("float32",) if case.road_shares or (case.clip_s and kind == "cpu") else options.precisions:
            for row in in_process(name, precision, options):
                line, head = LINES[row["kind"]](row)
                if head != heading:
                    out.print(f"\n{head}", **PLAIN)
                    heading = head
                out.print(line, **PLAIN)
                yield row


def in_process(name: str, precision: str, options: Options) -> list[Row]:
    """The rows of a case, measured by a new process of this script."""
    command = [sys.executable, __file__, "--only", name, precision, "--repeats", str(options.repeats)]
    command += ["--threads", str(options.thread_count), "--device", options.device]
    # Threads that wait for each other sleep, so that CPU time is work.
    environment = {"OMP_WAIT_POLICY": "passive", **os.environ}
    with progress(name) as advance:
        advance(f"{precision}, in a process of its own", 0.5)
        ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if ran.returncode != 0:
        last = (ran.stderr.strip() or "no output").splitlines()[-1]
        out.print(f"{name} {precision} could not be measured: {last}", **PLAIN)
        return []
    return json.loads(ran.stdout.splitlines()[-1])


def why_no_gpu(device: str) -> str | None:
    """Why nothing can run on a device, None if it can."""
    import torch

    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        return str(error).splitlines()[0]
    return None


# -------------------------------------------------------------------------------------- in the process of one case


def measured(name: str, precision: Any, options: Options) -> list[Row]:
    """The rows of one case."""
    import torch

    torch.set_num_threads(options.thread_count)
    case = {**CASES, **QUICK_CASES}[name]
    with torch.inference_mode():
        if case.clip_s is not None:
            rows = [clip_row(name, case, precision, options)]
        elif case.road_shares:
            rows = slot_rows(name, case, precision, options)
        else:
            rows = [pass_row(name, case, precision, options)]
    facts = {
        "precision": precision,
        "device": options.device,
        "threads": options.thread_count,
        "limit_s": case.limit_s,
        "limit_gb": case.limit_gb,
        # Kilobytes on Linux.
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9,
        "load_average": os.getloadavg()[0],
    }
    if options.device != "cpu":
        facts["gpu"] = torch.cuda.get_device_name(options.device)
        facts["peak_gpu_gb"] = torch.cuda.max_memory_allocated(options.device) / 1e9
    return [{**row, "profile": case.profile, **facts} for row in rows]


def pass_row(name: str, case: Case, precision: Any, options: Options) -> Row:
    """Passes of a case's images through the whole network."""
    from nurec_sim import network

    model = network.build(case.profile, precision=precision).to(options.device)
    inputs = inputs_of(case, 0).to(options.device)
    outputs, operations = counted(lambda: model(inputs))
    gaussians = outputs.gaussians.opacity.numel()
    del outputs
    wall, cpu = timed([lambda: model(inputs)], options)[0]
    return {
        "name": f"{name} {precision}",
        "kind": "pass",
        "images": case.cameras * case.frames,
        "width": inputs.rgb.shape[3],
        "height": inputs.rgb.shape[2],
        "parameters": sum(parameter.numel() for parameter in model.parameters()),
        "gaussians": gaussians,
        "tflop": operations / 1e12,
        "s_median": wall,
        "cpu_s_median": cpu,
        "gflop_per_s": operations / 1e9 / wall,
        "gflop_per_cpu_s": operations / 1e9 / cpu,
        "passes": options.repeats,
    }


def slot_rows(name: str, case: Case, precision: Any, options: Options) -> list[Row]:
    """The selective decoder at several shares of road, with our rule and the release's in turns."""
    from nurec_sim import network

    model = network.build(case.profile, precision=precision).to(options.device)
    inputs = inputs_of(case, 0).to(options.device)
    model(inputs)
    whole = timed([lambda: model(inputs)], dataclasses.replace(options, repeats=1))[0][0]
    rows = []
    for share in case.road_shares:
        features, context = features_and_context(model, inputs, share)

        def decode(fill: bool, features=features, context=context) -> Any:
            model.decoder.fill_road_slots = fill
            return model.decoder.gaussians(features, context, inputs)

        (ours, operations), (theirs, their_operations) = (
            counted(lambda fill=fill, decode=decode: decode(fill)) for fill in (False, True)
        )
        (wall, cpu), (their_wall, their_cpu) = timed(
            [lambda fill=fill, decode=decode: decode(fill) for fill in (False, True)], options
        )
        cell = model.decoder.size.cell**2
        rows.append(
            {
                "name": f"{name}, {100 * share:.0f} % road",
                "kind": "slots",
                "images": case.cameras * case.frames,
                "road_share": share,
                "tokens": ours.opacity.numel() // cell,
                "tokens_release": theirs.opacity.numel() // cell,
                "tflop": operations / 1e12,
                "tflop_release": their_operations / 1e12,
                "s_median": wall,
                "s_median_release": their_wall,
                "cpu_s_median": cpu,
                "cpu_s_median_release": their_cpu,
                "ratio": cpu / their_cpu if options.device == "cpu" else wall / their_wall,
                "s_whole_pass": whole,
                "passes": options.repeats,
            }
        )
    return rows


def clip_row(name: str, case: Case, precision: Any, options: Options) -> Row:
    """A clip to layers, end to end; the time is without making the network and its weights."""
    from nurec_sim.reconstruct import FeedForwardSettings, reconstruct

    settings = FeedForwardSettings(
        case.profile,
        random_weights=0,
        device=options.device,
        precision=precision,
        chunking="non-overlapping",
        frames=case.frames,
    )
    drive = Drive(case.cameras, case.clip_s or 0.0)
    runs = []
    # The first run on a GPU also makes its kernels.
    for _ in range(1 if options.device == "cpu" else 1 + options.repeats):
        events: list[tuple[float, str]] = []
        scene = reconstruct(
            drive, settings=settings, method="dense",
            progress=lambda stage, done, events=events: events.append((time.perf_counter(), stage)),
        )  # fmt: skip
        events.append((time.perf_counter(), ""))
        stages: dict[str, float] = defaultdict(float)
        for (began, stage), (ended, _) in zip(events, events[1:], strict=False):
            stages[stage.rsplit(": ", 1)[-1]] += ended - began
        loading = stages.pop("weights")
        runs.append((sum(stages.values()), loading, dict(stages)))
    total, loading, stages = sorted(runs[1:] or runs, key=lambda run: run[0])[len(runs[1:]) // 2]
    return {
        "name": f"{name} {precision}",
        "kind": "clip",
        "clip_s": case.clip_s,
        "cameras": case.cameras,
        "chunks": len(scene.provenance["chunks"]),
        "gaussians": len(scene.static) + len(scene.dynamic),
        "s_median": total,
        "s_loading": loading,
        "stages": stages,
    }


def counted(work: Callable[[], Any]) -> tuple[Any, int]:
    """The result of some work, and its floating-point operations in matrix products, convolutions and attention."""
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    def attention(query, key, value, *args, **kwargs) -> int:
        return 2 * query[0] * query[1] * query[2] * key[2] * (query[3] + value[3])

    # torch itself counts attention on GPUs only.
    on_cpu = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
    with FlopCounterMode(display=False, custom_mapping={on_cpu: attention}) as counter:
        result = work()
    return result, counter.get_total_flops()


def timed(works: Sequence[Callable[[], Any]], options: Options) -> list[tuple[float, float]]:
    """Median wall and CPU seconds of works that take turns, what they leave to a GPU included; they have run before."""
    import torch

    def wait() -> None:
        if options.device != "cpu":
            torch.cuda.synchronize(options.device)

    turns = []
    for _ in range(options.repeats):
        turn = []
        for work in works:
            wait()
            wall, cpu = time.perf_counter(), time.process_time()
            work()
            wait()
            turn.append((time.perf_counter() - wall, time.process_time() - cpu))
        turns.append(turn)
    return [(float(wall), float(cpu)) for wall, cpu in np.median(np.array(turns), axis=0)]


# --------------------------------------------------------------------------------------------------- what is printed


def verdicts(rows: Sequence[Row]) -> Iterator[str]:
    """One line per limit whose rows were measured; times hold for two threads of a machine with nothing else to do."""
    for row in rows:
        if row["limit_s"] is not None:
            yield bars.verdict(row["name"], row["s_median"], row["limit_s"], "s")
        if row["limit_gb"] is not None:
            yield bars.verdict(f"peak memory of {row['name']}", row["peak_gb"], row["limit_gb"], "GB")
        if row["kind"] == "slots" and row["tokens"] < row["tokens_release"]:
            yield bars.verdict(f"{row['name']}, CPU time over the release's rule", row["ratio"], 1.0, "x")


def pass_line(row: Row) -> tuple[str, str]:
    """A row of passes and its heading."""
    head = (
        f"{'one pass':28s} {'images':>13s} {'M par':>6s} {'TFLOP':>7s} {'s':>7s} {'cpu s':>7s} {'GFLOP/s':>8s}"
        f" {'/cpu s':>7s} {'GB':>5s} {'Gaussians':>10s} {'load':>5s}"
    )
    images = f"{row['images']} x {row['width']}x{row['height']}"
    return (
        f"{row['name']:28s} {images:>13s} {row['parameters'] / 1e6:6.1f} {row['tflop']:7.3f} {row['s_median']:7.2f}"
        f" {row['cpu_s_median']:7.2f} {row['gflop_per_s']:8.0f} {row['gflop_per_cpu_s']:7.0f} {row['peak_gb']:5.2f}"
        f" {row['gaussians']:10,d} {row['load_average']:5.1f}"
    ), head


def slot_line(row: Row) -> tuple[str, str]:
    """A comparison of the two rules, ours / the release's, and its heading."""
    head = (
        f"{'decoder: ours/release':28s} {'tokens':>13s} {'TFLOP':>13s} {'s':>13s} {'cpu s':>13s} {'ratio':>6s}"
        f" {'one pass, s':>12s} {'load':>5s}"
    )
    pairs = [f"{row[key]:.3f}/{row[key + '_release']:.3f}" for key in ("tflop", "s_median", "cpu_s_median")]
    tokens = f"{row['tokens']}/{row['tokens_release']}"
    return (
        f"{row['name']:28s} {tokens:>13s} {pairs[0]:>13s} {pairs[1]:>13s} {pairs[2]:>13s} {row['ratio']:6.2f}"
        f" {row['s_whole_pass']:12.2f} {row['load_average']:5.1f}"
    ), head


def clip_line(row: Row) -> tuple[str, str]:
    """A row of a clip, end to end, and its heading."""
    head = f"{'clip to layers':28s} {'seconds':>8s} {'chunks':>7s} {'s':>7s} {'GB':>5s} {'Gaussians':>10s}  stages, s"
    stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in row["stages"].items())
    return (
        f"{row['name']:28s} {row['clip_s']:8.0f} {row['chunks']:7d} {row['s_median']:7.2f} {row['peak_gb']:5.2f}"
        f" {row['gaussians']:10,d}  {stages}"
    ), head


LINES = {"pass": pass_line, "slots": slot_line, "clip": clip_line}


if __name__ == "__main__":
    sys.exit(main())
