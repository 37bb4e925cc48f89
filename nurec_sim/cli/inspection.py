"""The command ``inspect``: contents and faults of a log or a scene archive."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from nurec_sim.cli.console import OnePath, app, out, print_faults, print_table, progress
from nurec_sim.cli.validation import inspect_scene
from nurec_sim.errors import NurecSimError
from nurec_sim.files.new_files import check_writable, new_file, write_file
from nurec_sim.geometry import arc_length

if TYPE_CHECKING:
    from nurec_sim.logs import Clip


@app.command
def inspect(
    source: OnePath, *, overlay: Path | None = None, time_s: float | None = None, html: Path | None = None
) -> None:
    """Show the contents of a driving log or a scene archive, and check it.

    Prints a table of sensors, rates, spans and boxes; the consistency of ground, cameras, LiDARs and boxes; for a log
    without boxes what moves in its sweeps; then every fault as one line. Exit status 1 if there are faults.

    Args:
        source: a driving log of any format (docs/log_formats.md), or a scene archive (.usdz).
        overlay: write a PNG with LiDAR points (red near, blue far) and boxes over the image of each camera; clips only.
        html: write a page with all of it, and with timeline, map and images; clips only.
        time_s: time of the overlay in seconds after the start of the clip; default: the middle.
    """
    from nurec_sim import logs
    from nurec_sim.logs.describe import SENSOR_COLUMNS
    from nurec_sim.serving.store.sources import is_archive

    if time_s is not None and overlay is None:
        raise NurecSimError("--time-s is the time of the --overlay image; give both")
    if time_s is not None and not math.isfinite(time_s):
        raise NurecSimError(f"--time-s must be a number of seconds, got {time_s}")
    if is_archive(source):
        if overlay is not None:
            raise NurecSimError(f"--overlay draws over the images of a clip; {source} is a scene archive")
        if html is not None:
            raise NurecSimError(f"--html shows a clip; {source} is a scene archive")
        return inspect_scene(source)
    if html is not None:
        check_writable(html)
    log = logs.open_clip(source)
    summary = logs.describe_clip(log)
    print_table(f"clip {log.id}", summary.facts)
    print_table("sensors", summary.sensors, SENSOR_COLUMNS)
    if overlay is not None:
        _write_overlay(log, overlay, time_s)
    with progress("reading every image and sweep"):
        faults = logs.check_clip(log)
    with progress("comparing ground, cameras and boxes with the LiDAR"):
        measures = logs.measure_clip(log)
    if measures:
        print_table("consistency", [(each.what, each.found) for each in measures])
    shown = log if log.tracks else _with_found_actors(log)
    if html is not None:
        from nurec_sim.report.log_page import log_page

        with progress(f"writing {html.name}"):
            write_file(html, log_page(shown, faults, measures))
        out.print(f"wrote {html}", soft_wrap=True)
    print_faults([*faults, *(fault for each in measures for fault in each.faults)])
    out.print("no faults")


def _with_found_actors(log: Clip) -> Clip:
    """A log without boxes with what moves in its sweeps, which is printed."""
    from nurec_sim.logs.selection import with_tracks
    from nurec_sim.reconstruct.movers import find_actors

    with progress("looking for what moves in the sweeps") as advance:
        tracks = find_actors(log, progress=lambda done: advance("what moves", done))
    if not tracks:
        return log
    rows = []
    for track in tracks:
        seconds = (track.path.end_us - track.path.start_us) / 1e6
        moved_m = arc_length(track.path.position_m)[-1]
        size = " x ".join(f"{edge:.1f}" for edge in track.size_m)
        seen = f"{(track.path.start_us - log.span_us[0]) / 1e6:.1f} to {(track.path.end_us - log.span_us[0]) / 1e6:.1f}"
        rows.append((track.id, track.label, size, seen, f"{moved_m / seconds:.1f}"))
    print_table("no boxes; found by motion", rows, ("actor", "looks like", "size m", "seen s", "m/s"))
    return with_tracks(log, tracks)


def _write_overlay(log: Clip, path: Path, time_s: float | None) -> None:
    from nurec_sim import logs
    from nurec_sim.render.images.encode import encode_image

    start_us, end_us = log.span_us
    t_us = (start_us + end_us) // 2 if time_s is None else start_us + round(time_s * 1e6)
    picture = encode_image(logs.draw_overlay(log, t_us))
    with new_file(path) as file:
        file.write(picture)
    out.print(f"wrote {path}", soft_wrap=True)
