"""Verbs about one log or scene: reconstruct, render."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import tyro

from nurec_sim.cli.console import OnePath, app, chosen_device, out, print_table, progress
from nurec_sim.cli.inputs import PosesName, with_poses
from nurec_sim.errors import NurecSimError
from nurec_sim.files.new_files import check_writable
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.reconstruct.optimize.settings import OptimizeSettings
from nurec_sim.types import ActorsName

if TYPE_CHECKING:
    from nurec_sim.serving.store import LoadedScene

MethodName = Annotated[str, tyro.conf.arg(metavar="NAME|FILE.py:CLASS|MODULE:CLASS")]
NetworkFlags = Annotated[FeedForwardSettings, tyro.conf.arg(name="")]
NO_FLAGS = FeedForwardSettings()
NO_OPTIMISATION = "--budget bounds the Gaussians of an optimisation: give it {}"
"""When there is none."""


@app.command
def reconstruct(
    clip: OnePath,
    *,
    out_path: Annotated[Path | None, tyro.conf.arg(name="out")] = None,
    method: MethodName = "lift",
    cameras: tuple[str, ...] = (),
    poses: PosesName = "recorded",
    actors: ActorsName = "auto",
    align_actors: bool = True,
    align_sweeps: bool = True,
    complete_actors: bool = True,
    map_from_gaussians: bool = False,
    refine: float | None = None,
    budget: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    changes: Annotated[
        tuple[str, ...], tyro.conf.arg(name="set", metavar="NAME=VALUE"), tyro.conf.UseAppendAction
    ] = (),
    network: NetworkFlags = NO_FLAGS,
) -> None:
    """Turn a driving log into a Gaussian scene archive (.usdz).

    Methods: `lift` colours LiDAR points, without learning. `dense` and `selective` are the Instant NuRec network, with
    one Gaussian per pixel or clusters around selected points; the second group of options applies to them. `nurec-sim
    weights list` shows profiles and local weights. `optimized` optimises the result of `lift` on the log for five
    minutes, or for --refine seconds; --refine does so after any other method. Ctrl-C during optimisation keeps its
    best result so far; the same command with --resume goes on from there, also after a kill.

    Args:
        clip: a driving log, such as a clip folder or a KITTI drive (docs/log_formats.md).
        out_path: the archive to write; default: CLIP's name with .usdz in the current folder.
        method: lift, dense, selective, optimized, one of an installed package, or a class (docs/write_a_method.md).
        changes: a setting of the method, repeatable: --set sky_px=256 --set views.levels=48.
        cameras: use only these cameras; default: all, or as many as the network's profile supports.
        poses: those of the log, or refined by its LiDAR (docs/log_formats.md).
        actors: whose objects move, instead of being part of the static world: recorded (boxes of the log), found (what
            moves in its LiDAR sweeps, named found-1, found-2, ...), none; auto: recorded, or found if the log has no
            boxes at all.
        align_actors: correct tracks of moving objects so that the returns of all LiDAR sweeps on an object make one
            surface (docs/lift.md).
        align_sweeps: correct elevations of LiDAR beams, mountings of LiDARs and poses so that all sweeps see the same
            planes and images show them where they are, and mountings of cameras so that they show the same where they
            overlap, if they disagree (docs/log_formats.md).
        complete_actors: give actors that the sensors hardly saw a body of their class where nothing was
            measured, so that they are seen when they or the ego drive elsewhere (docs/lift.md).
        map_from_gaussians: for a log without a map, write one for other simulators (map.xodr) with the area of the
            road-class Gaussians.
        refine: time budget in seconds for optimising the scene on the log's images and sweeps.
        budget: with --refine or `optimized`, the most static Gaussians: more are merged before the optimisation.
        resume: go on with an optimisation that was interrupted, from its state in OUT.refine.npz; its archive is
            replaced.
        overwrite: replace an existing archive.
        network: network settings; --device also applies to --refine and `optimized`.
    """
    from nurec_sim import logs, scene
    from nurec_sim.reconstruct import reconstruct as run_method

    settings = method_settings(method, network, changes, refine, budget=budget)
    log = logs.open_clip(clip)
    target = out_path or Path(f"{log.id}.usdz")
    if target.exists() and not overwrite and not resume:
        raise NurecSimError(f"{target} exists; give another --out, or --overwrite")
    settings, fit = _with_checkpoint(method, settings, refinement(refine, network.device, budget), target, resume)
    check_writable(target)
    log = with_poses(log, poses)
    with progress("reconstructing") as advance:
        world_scene = run_method(
            log,
            method,
            cameras=cameras or None,
            progress=advance,
            settings=settings,
            refine=fit,
            actors=actors,
            align_actors=align_actors,
            align_sweeps=align_sweeps,
            complete_actors=complete_actors,
        )
    derived = None
    if map_from_gaussians and world_scene.road_map is None:
        from nurec_sim.metrics.offroad_grid import road_map_of_grid, scene_offroad_grid

        derived = road_map_of_grid(scene_offroad_grid(world_scene))
        told = {"map_xodr": "drivable area from the road-class Gaussians, lane along the recorded path; not surveyed"}
        world_scene = dataclasses.replace(world_scene, provenance={**world_scene.provenance, **told})
    with progress(f"writing {target.name}"):
        scene.write_scene(world_scene, target, overwrite=overwrite or resume, derived_map=derived)
    print_table(f"scene {world_scene.id}", scene.summary(world_scene))
    for text in world_scene.provenance.get("unknown", ()):
        out.print(f"not known: {text}", markup=False)
    if completed := world_scene.provenance.get("completed_actors"):
        out.print(f"{len(completed)} actors were hardly seen: they have bodies of their class (docs/lift.md)")
    out.print(f"wrote {target} ({target.stat().st_size / 1e6:.1f} MB)", soft_wrap=True)
    if (kept := _checkpoint_of(target)).exists():
        out.print(f"the optimisation was interrupted: the same command with --resume goes on ({kept})", soft_wrap=True)


@app.command
def render(
    source: OnePath,
    *,
    out_path: Annotated[Path, tyro.conf.arg(name="out")] = Path("frame.png"),
    camera: str | None = None,
    frame: int = 0,
    left_m: float = 0.0,
    yaw_deg: float = 0.0,
    layer: Literal["rgb", "depth", "alpha", "label", "normal", "support"] = "rgb",
    width: int | None = None,
    device: str = "auto",
) -> None:
    """Render one camera image of a scene to a PNG, at a recorded pose or beside it.

    Args:
        source: a scene archive or a driving log.
        out_path: the PNG to write.
        camera: camera id; default: the first.
        frame: index of the recorded frame that gives time and pose.
        left_m: lateral offset of the car in metres, left positive.
        yaw_deg: yaw offset of the car in degrees, left positive.
        layer: output layer; `support` shows the image, the redder the less it rests on what was recorded
            (docs/trust.md).
        width: image width in pixels; default: that of the camera.
        device: render device: auto (a GPU if available), cpu, cuda or cuda:N.
    """
    from nurec_sim.render.images.still import render_still

    check_writable(out_path)
    renderer = loaded(source, chosen_device(device)).renderer
    render_still(renderer, out_path, camera, frame, left_m=left_m, yaw_deg=yaw_deg, layer=layer, width_px=width)
    out.print(f"wrote {out_path}", soft_wrap=True)


def method_settings(
    method: str,
    network: FeedForwardSettings,
    given: Sequence[str] = (),
    refine: float | None = None,
    renders: bool = False,
    budget: int | None = None,
) -> Any:
    """Settings of a method: the flags of the network for those that use it, changed as ``--set NAME=VALUE`` says.

    Args:
        method: reference as ``load_method`` takes it.
        network: the flags. The device is also that of an optimisation.
        given: changes.
        refine: seconds for optimising what the method makes; None for none.
        renders: whether the command renders on the device.
        budget: the most static Gaussians of an optimisation.

    Raises:
        NurecSimError: flags of the network were given to a method without one, a budget without an optimisation, or a
            setting does not exist or fit.
        GpuError: the device of an optimisation cannot be used.
    """
    from nurec_sim.reconstruct import load_method

    made = load_method(method).settings
    optimizes = made is OptimizeSettings
    if budget is not None and refine is None and not optimizes:
        raise NurecSimError(NO_OPTIMISATION.format("with --refine or --method optimized"))
    used = {"device"} if optimizes or refine is not None or renders else set()
    if made is not FeedForwardSettings:
        flags = [
            "--" + each.name.replace("_", "-")
            for each in dataclasses.fields(network)
            if getattr(network, each.name) != getattr(NO_FLAGS, each.name) and each.name not in used
        ]
        if flags:
            raise NurecSimError(
                f"method {method!r} does not use {', '.join(flags)}; choose --method dense or selective"
            )
    settings: Any = network if made is FeedForwardSettings else None
    if optimizes and refine is None and (network.device != NO_FLAGS.device or budget is not None):
        settings = refinement(OptimizeSettings().seconds, network.device, budget)
    for text in given:
        name, equals, value = text.partition("=")
        if not equals:
            raise NurecSimError(f"--set takes NAME=VALUE, got {text!r}")
        settings = _changed(made() if settings is None else settings, name, name.split("."), value)
    return settings


def _changed(settings: Any, name: str, path: Sequence[str], value: str) -> Any:
    """Settings with one field, maybe of a group of settings, read from a text."""
    from pydantic import TypeAdapter, ValidationError

    types = get_type_hints(type(settings))
    if path[0] not in types:
        raise NurecSimError(f"--set: there is no setting {name!r}; have {sorted(types)}")
    inner = getattr(settings, path[0])
    try:
        if len(path) > 1:
            parsed = _changed(inner, name, path[1:], value)
        else:
            parsed = None if value == "none" else value
            parsed = TypeAdapter(types[path[0]]).validate_python(parsed)
        return dataclasses.replace(settings, **{path[0]: parsed})
    except (ValidationError, ValueError) as error:
        why = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise NurecSimError(f"--set {name}={value}: {why}") from None


def refinement(seconds: float | None, device: str = "auto", budget: int | None = None) -> OptimizeSettings | None:
    """Optimisation settings for a budget of time, a device and a budget of Gaussians; None without time.

    Raises:
        NurecSimError: a budget is not positive.
        GpuError: the device cannot be used; better told now than after the reconstruction.
    """
    if seconds is None:
        return None
    from nurec_sim.render.device import choose_device

    try:
        return OptimizeSettings(seconds=seconds, device=choose_device(device).name, max_gaussians=budget)
    except ValueError as error:
        flag = "--budget" if str(error).startswith("max_gaussians") else "--refine"
        raise NurecSimError(f"{flag}: {error}") from None


def _checkpoint_of(target: Path) -> Path:
    """Where the state of an optimisation lies while it runs."""
    return target.with_name(f"{target.name}.refine.npz")


def _with_checkpoint(
    method: str, settings: Any, fit: OptimizeSettings | None, target: Path, resume: bool
) -> tuple[Any, OptimizeSettings | None]:
    """Settings of the method and of the optimisation, which keeps its state beside the archive."""
    from nurec_sim.reconstruct import load_method

    kept: dict[str, Any] = {"checkpoint": _checkpoint_of(target), "resume": resume}
    if fit is not None:
        return settings, dataclasses.replace(fit, **kept)
    if load_method(method).settings is OptimizeSettings:
        return dataclasses.replace(settings or OptimizeSettings(), **kept), None
    if resume:
        raise NurecSimError(f"--resume goes on with an optimisation; give --refine, or --method optimized ({method!r})")
    return settings, None


def loaded(source: Path, device: str) -> LoadedScene:
    """A scene from an archive, or from a clip that is reconstructed now, and its renderer."""
    from nurec_sim.serving.store import SceneStore

    store = SceneStore([source], device=device)
    for fault in store.faults.values():
        raise NurecSimError(fault)
    with progress("loading") as advance:
        return store.get(store.ids[0], progress=advance)
