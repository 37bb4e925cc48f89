"""Verbs that trade scenes with other programs: export, import."""

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
    """Write a scene as a 3DGS PLY, for viewers and other simulators, with its sky beside it.

    Three files: X.ply holds the Gaussians, X.sky.npz the sky cubemap and the cameras' colour corrections, X.sky.png the
    sky as a picture. A PLY holds one instant: without --at-us the moving Gaussians are left out. docs/exchange.md says
    which viewers were tried and what a PLY does not keep.

    Args:
        scene: a scene archive or a clip.
        out_path: the PLY to write.
        layout: inria has the properties that all 3DGS programs know; release those of the public Instant NuRec release,
            which keep what is road, but which some viewers misread.
        up: axis of the files that points up; y for viewers based on three.js (Spark, gsplat.js).
        at_us: also write the moving Gaussians, where and as opaque as they are at this time.
        overwrite: replace files that are there.
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
        hint = f"{exported.moving_left_out:,} (--at-us {start_us} to {end_us - 1} has them as they are then)"
        left_out.append(("left out: moving", hint))
    if layout == "inria" and (world.static.label == Label.ROAD).any():
        left_out.append(("not kept", "which Gaussians are road (--layout release keeps it)"))
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
    """Make a scene archive (.usdz) from a file of another program.

    A 3DGS PLY: ours, the Instant NuRec release's, any trained one, or a compressed one (SuperSplat); SPZ. A NuRec
    archive (.usdz), or its volume.nurec or checkpoint.ckpt alone. OpenUSD particle fields (.usdz, .usda, .usdc, .usd).

    What a file does not know, sensors with path and times, boxes, map, sky or colour corrections, comes from --like;
    without it the car stands at the origin for one second with one camera that looks along x, under a black sky. What
    is not known or not read is listed below the table. A PLY's lengths are taken for metres.

    Ours again: nurec-sim import demo.ply --like scenarios/demo_clip.zip

    Trained on COLMAP poses: nurec-sim import garden.ply --up=-y

    Args:
        file: the file (docs/exchange.md says what a PLY must have, docs/foreign_scenes.md what is read of others).
        out_path: the archive to write; the file's name with .usdz in the current folder if not given.
        sky: a .sky.npz file; X.sky.npz beside X.ply if not given and it is there.
        like: a scene archive or a clip of the same place; a clip has no sky and no colour corrections.
        up: which axis of a PLY or SPZ file points up; -y for most trained PLY files. Unless given it is y for SPZ, and
            for a PLY what our export noted in it, else z.
        overwrite: replace an archive that is there.
    """
    from nurec_sim import logs, scene

    target = out_path or Path(f"{file.stem}.usdz")
    if target.exists() and not overwrite:
        raise NurecSimError(f"{target} exists; give another --out, or --overwrite")
    if file.resolve() == target.resolve():
        raise NurecSimError(f"{target} is the file to import; give another --out")
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
