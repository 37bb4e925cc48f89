"""The verb that compares scenes of one log: compare."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import tyro

from nurec_sim.cli.console import Paths, app, chosen_device, out, print_table, progress
from nurec_sim.errors import NurecSimError
from nurec_sim.files.new_files import check_writable, write_file


@app.command
def compare(
    scenes: Paths,
    *,
    clip: Path,
    out_path: Annotated[Path, tyro.conf.arg(name="out")] = Path("comparison.html"),
    target_cameras: tuple[str, ...] = (),
    hold_out_every: int = 0,
    hold_out_sweeps: int = 0,
    device: str = "auto",
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Compare scenes of one log: every figure of `evaluate CLIP` side by side, worst frames and a video in one report.

    Args:
        scenes: two or more scene archives (.usdz) made from the log; the first is the one that others are measured by.
        clip: the log, a clip folder or a .zip of one.
        out_path: the HTML report to write.
        target_cameras: cameras to compare with; the first scene's input cameras if not given.
        hold_out_every: every N-th image of the input cameras was held out of all scenes.
        hold_out_sweeps: every N-th sweep was held out of all scenes.
        device: auto, cpu or cuda.
        json_path: also write all figures here.
    """
    from nurec_sim import logs, scene
    from nurec_sim.evaluate import compare_scenes, render_comparison, side_by_side

    if len(scenes) < 2:
        raise NurecSimError(f"a comparison needs two scenes or more, got {[str(path) for path in scenes]}")
    for path in scenes:
        if not path.is_file():
            raise NurecSimError(f"{path}: no such scene archive")
    check_writable(out_path)
    if json_path is not None:
        check_writable(json_path)
    log = logs.open_clip(clip)
    names = _names(scenes)
    with progress("comparing") as advance:
        first = scene.read_scene(scenes[0])
        cameras = [camera for camera in first.provenance.get("cameras", first.rig.cameras) if camera in log.rig.cameras]
        found = compare_scenes(
            log,
            {name: lambda path=path: scene.read_scene(path) for name, path in names.items()},
            logs.hold_out(log, cameras, images_every=hold_out_every, sweeps_every=hold_out_sweeps),
            target_cameras=target_cameras or None,
            device=chosen_device(device),
            progress=advance,
        )
    write_file(out_path, render_comparison(found))
    if json_path is not None:
        write_file(json_path, json.dumps(found.figures, indent=1, sort_keys=True) + "\n")
    table = side_by_side(found.figures)
    for group in dict.fromkeys(group for group, _, _ in table):
        rows = [(name, *(row.text if row else "none" for row in each)) for at, name, each in table if at == group]
        print_table(group, rows, ("figure", *names))
    out.print(f"wrote {out_path}", soft_wrap=True)


def _names(paths: tuple[Path, ...]) -> dict[str, Path]:
    """Short names that tell the files apart."""
    stems = [path.stem for path in paths]
    return {
        stem
        if stems.count(stem) == 1
        else f"{path.parent.name}/{stem}"
        if path.parent.name
        else f"{stem} {k + 1}": path
        for k, (stem, path) in enumerate(zip(stems, paths, strict=True))
    }
