"""Commands that exchange scenes with other programs: export, import."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from nurec_sim.cli.console import OnePath, app, out, print_table, progress
from nurec_sim.cli.scenes import loaded
from nurec_sim.errors import NurecSimError
from nurec_sim.files.new_files import check_writable

UpAxis = Literal["z", "-z", "y", "-y", "x", "-x"]


@app.command
def export(
    scene: OnePath,
    *,
    out_path: Annotated[Path, tyro.conf.arg(name="out")],
    layout: Literal["inria", "release"] = "inria",
    up: UpAxis = "z",
    at_us: int | None = None,
    overwrite: bool = False,
) -> None:
    """Write a scene as a 3DGS PLY with a sky file, for viewers and other simulators.

    Three files: X.ply has the Gaussians, X.sky.npz the sky cubemap and the cameras' colour corrections, X.sky.png a
    preview of the sky. A PLY represents one instant: without --at-us moving Gaussians are skipped. docs/exchange.md
    lists tested viewers and what a PLY cannot store.

    Args:
        scene: a scene archive or a clip.
        out_path: the PLY to write.
        layout: inria is the standard 3DGS layout; release is that of the public Instant NuRec release, which stores
            road labels but is misread by some viewers.
        up: up axis of the files; y for viewers based on three.js (Spark, gsplat.js).
        at_us: also write the moving Gaussians, with their position and opacity at this time.
        overwrite: replace existing files.
    """
    from nurec_sim.scene import export_scene
    from nurec_sim.types import Label

    check_writable(out_path)
    world = loaded(scene, "cpu").scene
    with progress("exporting") as advance:
        exported = export_scene(
            world, out_path, layout=layout, up=up, at_us=at_us, overwrite=overwrite, progress=advance
        )
    left_out = [("left out: not finite, or without extent", f"{exported.not_finite:,}")] if exported.not_finite else []
    if exported.moving_left_out:
        start_us, end_us = world.span_us
        hint = f"{exported.moving_left_out:,} (use --at-us {start_us} to {end_us - 1} to include them)"
        left_out.append(("left out: moving", hint))
    if layout == "inria" and (world.static.label == Label.ROAD).any():
        left_out.append(("not stored", "road labels (--layout release stores them)"))
    sky = f"6 x {world.sky.shape[1]} x {world.sky.shape[2]}"
    rows = [("Gaussians", f"{exported.written:,}"), *left_out, ("sky", sky),
            ("colour correction", ", ".join(world.isp) or "none")]  # fmt: skip
    print_table(f"scene {world.id}", rows)
    for path in exported.paths:
        out.print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)", soft_wrap=True)


@app.command(name="import")
def import_(
    file: OnePath,
    *,
    out_path: Annotated[Path | None, tyro.conf.arg(name="out")] = None,
    sky: Path | None = None,
    like: Path | None = None,
    up: UpAxis | None = None,
    overwrite: bool = False,
) -> None:
    """Convert a third-party scene to a scene archive (.usdz).

    Formats: any 3DGS PLY, compressed PLY (SuperSplat), SPZ; NuRec archives (.usdz), or volume.nurec or checkpoint.ckpt
    alone; OpenUSD particle fields (.usdz, .usda, .usdc, .usd).

    Missing sensors with path and times, tracks, map, sky or colour corrections come from --like; without it the car is
    at the origin for one second with one camera facing along x, under a black sky. Missing and ignored parts are listed
    below the table. Lengths are assumed to be metres.

    Our own export: nurec-sim import demo.ply --like scenarios/demo_clip.zip

    Trained on COLMAP poses: nurec-sim import garden.ply --up=-y

    Args:
        file: the file to import (formats: docs/exchange.md, docs/foreign_scenes.md).
        out_path: the archive to write; default: the file's name with .usdz in the current folder.
        sky: a .sky.npz file; default: X.sky.npz beside X.ply, if it exists.
        like: a scene archive or a clip of the same place; a clip has no sky and no colour corrections.
        up: up axis of a PLY or SPZ file; -y for most trained PLY files. Default: y for SPZ; for PLY the axis recorded
            by our export, else z.
        overwrite: replace an existing archive.
    """
    from nurec_sim import logs, scene

    target = out_path or Path(f"{file.stem}.usdz")
    if target.exists() and not overwrite:
        raise NurecSimError(f"{target} exists; give another --out, or --overwrite")
    if file.resolve() == target.resolve():
        raise NurecSimError(f"--out --out {target} is the file to import; give another --out")
    check_writable(target)
    with progress(f"reading {file.name}"):
        opened = scene.read_scene if like and like.suffix.lower() in scene.SCENE_SUFFIXES else logs.open_clip
        known = None if like is None else opened(like)
        world = scene.import_scene(file, sky=sky, like=known, up=up)
    with progress(f"writing {target.name}"):
        scene.write_scene(world, target, overwrite=overwrite)
    dropped = world.provenance.get("dropped")
    rows = [("dropped: not finite, or without extent", f"{dropped:,}")] if dropped else []
    print_table(f"scene {world.id}", [*scene.summary(world), *rows])
    for text in world.provenance.get("unknown", ()):
        out.print(f"not known: {text}", markup=False)
    out.print(f"wrote {target} ({target.stat().st_size / 1e6:.1f} MB)", soft_wrap=True)
