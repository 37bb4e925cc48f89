"""Times the renderer on seeded scenes and one real log, with its distance from the float64 reference beside every time.

Sensors and back ends of a scene take turns frame by frame in one process, every frame from another pose of the path.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import backward
import bars
import first_frame
import parity
import plan
import timing
import tyro
from plan import Options
from scenes import BenchScene

from nurec_sim.cli import console
from nurec_sim.cli.console import err, out
from nurec_sim.render import CpuRenderer

PLAIN: dict[str, Any] = {"markup": False, "highlight": False, "soft_wrap": True}
HEADING = (
    f"{'sensor':20s} {'path':7s} {'backend':16s} {'size':>9s} {'ms':>8s} {'p99':>8s} {'cpu':>8s} {'first':>8s}"
    f" {'eval/px':>8s} {'dB':>6s} {'depth':>6s} {'alpha':>6s} {'label':>6s}  stages"
)


def main() -> None:
    """Run the benchmark."""
    options = tyro.cli(Options)
    if options.quick:
        options = plan.quick(options)
    facts = {"machine": machine_name(), "simd": instruction_set()}
    load = os.getloadavg()[0]
    out.print(f"{facts['machine']}, {facts['simd']}, {options.thread_count} threads, load {load:.2f}", **PLAIN)
    rows: list[dict[str, Any]] = []
    try:
        for name in options.scenes:
            for row in scene_rows(name, options):
                rows.append({**row, **facts} | {"simd": row.get("simd", facts["simd"])})
                write(rows, options.output)
    except KeyboardInterrupt:
        write(rows, options.output)
        err.print(f"interrupted: the {len(rows)} rows that were done are in {options.output}", **PLAIN)
        raise SystemExit(130) from None
    for line in bars.verdicts(rows):
        out.print(line, **PLAIN)
    out.print(f"wrote {len(rows)} rows to {options.output}", **PLAIN)


def scene_rows(name: str, options: Options) -> Iterator[dict[str, Any]]:
    """Build a scene, time all that is planned for it, and yield its rows as their parity becomes known."""
    with progress(name) as advance:
        advance("making the scene", 0.0)
        built = plan.build(name, options, advance)
        advance("packing the scene", 0.9)
        renderer = CpuRenderer(built.scene, threads=options.thread_count)
        entries, notes = plan.entries(name, built, renderer, options)
    out.print(f"\n{name}: {plan.count(built.scene):,} Gaussians. {built.about}", **PLAIN)
    for note in notes:
        out.print(note, **PLAIN)
    interrupted = not all_timed(name, entries)
    out.print(HEADING, **PLAIN)
    for entry in entries:
        if not interrupted:
            try:
                with progress(f"{name}: parity") as advance:
                    advance(f"{entry.facts['sensor']} {entry.facts['backend']}", 0.5)
                    entry.figures.update(timing.account(entry))
                    entry.figures.update(compared(built, entry, entries, options.parity_rays))
            except KeyboardInterrupt:
                interrupted = True
        if entry.wall_ms:
            if entry.facts["name"] == plan.FIRST_FRAME_ROW and options.extras and not interrupted:
                asked = entry.ticks[0][0]
                entry.figures.update(first_frame.measure(built.scene, asked, options.thread_count, plan.BUILD))
            row = {**parity.NOTHING, **entry.row()}
            out.print(line_of(row), **PLAIN)
            yield row
    if interrupted:
        raise KeyboardInterrupt
    if name == "driving" and options.extras:
        yield from extra_rows(name, built, options)


def all_timed(name: str, entries: Sequence[timing.Entry]) -> bool:
    """Time the entries in turns under a progress bar; False if Ctrl-C ended that early."""
    total, done = sum(len(entry.ticks) + 1 for entry in entries), 0
    with progress(f"{name}: timing") as advance:

        def tick(entry: timing.Entry) -> None:
            nonlocal done
            done += 1
            advance(f"{entry.facts['sensor']} {entry.facts['backend']}", done / total)

        try:
            timing.warm_up(entries, tick)
            first_s = sum(entry.first_ms or 0.0 for entry in entries) / 1e3
            out.print(f"warmed up: the first frames of {len(entries)} rows took {first_s:.1f} s", **PLAIN)
            timing.take_turns(entries, tick)
        except KeyboardInterrupt:
            return False
    return True


def compared(
    built: BenchScene, entry: timing.Entry, entries: Sequence[timing.Entry], parity_rays: int
) -> dict[str, Any]:
    """Distances of a row's middle frame from the reference, and of simplified scenes from the full one."""
    asked = entry.ticks[len(entry.ticks) // 2]
    frames = entry.render(asked)
    figures: dict[str, Any] = {}
    if parity_rays:
        figures.update(parity.against_spec(built.scene, asked, frames, parity_rays))
        figures["parity_rays"] = parity_rays
    full = entry.facts.get("full")
    for other in entries:
        if full is not None and other.facts["name"] == full:
            figures["psnr_vs_full_db"] = parity.image_psnr_db(frames, other.render(asked))
    return figures


def extra_rows(name: str, built: BenchScene, options: Options) -> Iterator[dict[str, Any]]:
    """What cannot take turns with the rest: gradients, and our kernels for other machines."""
    with progress(f"{name}: gradients") as advance:
        for row in backward.rows(name, built, options, lambda sensor: advance(sensor, 0.5)):
            out.print(line_of(row), **PLAIN)
            yield row
    yield from lesser_kernels(options)


def lesser_kernels(options: Options) -> Iterator[dict[str, Any]]:
    """Our own rows on machines without this one's vectors, each set in a process of its own."""
    for kernels in plan.LESSER_KERNELS:
        if kernels == instruction_set():
            continue
        target = plan.BUILD / f"bench_{kernels}.json"
        command = [sys.executable, __file__, "--scenes", "driving", "--paths", "drive", "--no-extras"]
        command += ["--sensors", *plan.LESSER_SENSORS, "--repeats", str(min(options.repeats, 10))]
        command += ["--threads", str(options.thread_count), "--parity-rays", str(options.parity_rays)]
        command += ["--output", str(target)]
        command += [] if options.gaussians is None else ["--gaussians", str(options.gaussians)]
        with progress(f"driving: kernels for {kernels}") as advance:
            advance("in a process of their own", 0.5)
            ran = subprocess.run(
                command, env={**os.environ, "NUREC_SIM_SIMD": kernels}, capture_output=True, text=True, check=False
            )
        if ran.returncode != 0:
            last = (ran.stderr.strip() or ran.stdout.strip() or "no output").splitlines()[-1]
            out.print(f"kernels for {kernels} could not be measured: {last}", **PLAIN)
            continue
        for row in json.loads(target.read_text()):
            if row["backend"] == "ours":
                row = {**row, "backend": f"ours {kernels}", "name": f"{row['name']} {kernels}"}
                out.print(line_of(row), **PLAIN)
                yield row


def line_of(row: dict[str, Any]) -> str:
    """A row as one line of the table."""

    def number(key: str, width: int, digits: int = 1) -> str:
        value = row.get(key)
        return f"{'-' if value is None else format(value, f'.{digits}f'):>{width}s}"

    stages = " ".join(f"{stage} {value:.1f}" for stage, value in (row.get("stages") or {}).items())
    extra = [stages]
    if row.get("lidar_range_error_m_median") is not None:
        extra.append(f"range error {1e3 * row['lidar_range_error_m_median']:.3f} mm")
    for key, text in (("psnr_vs_full_db", "{:.1f} dB to full"), ("normal_agreement", "normals {:.4f}"),
                      ("backward_over_forward", "backward/forward {:.2f}")):  # fmt: skip
        if row.get(key) is not None:
            extra.append(text.format(row[key]))
    return (
        f"{row['sensor']:20s} {row['path']:7s} {row['backend']:16s} {row['width']:>4d}x{row['height']:<4d}"
        f" {number('ms_median', 8)} {number('ms_p99', 8)} {number('cpu_ms_median', 8)} {number('ms_first', 8)}"
        f" {number('evaluations_per_pixel', 8)} {number('psnr_vs_spec_db', 6)} {number('depth_psnr_db', 6)}"
        f" {number('alpha_psnr_db', 6)} {number('label_agreement', 6, 4)}  {', '.join(part for part in extra if part)}"
    )


def progress(title: str) -> contextlib.AbstractContextManager[console.Report]:
    """A progress bar, where someone watches."""
    return console.progress(title) if err.is_terminal else contextlib.nullcontext(lambda stage, fraction: None)


def write(rows: Sequence[dict[str, Any]], target: Path) -> None:
    """All rows, replacing the file as a whole."""
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_suffix(".part")
    part.write_text(json.dumps(rows, indent=1) + "\n")
    part.replace(target)


def machine_name() -> str:
    """The processor, as the operating system names it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def instruction_set() -> str:
    """The vectors that the kernels use."""
    from nurec_sim.render.cpu import simd

    return simd.INSTRUCTION_SET


if __name__ == "__main__":
    main()
