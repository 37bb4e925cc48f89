"""The command ``evaluate``: scores reconstructions of one log, or methods by a protocol."""

from __future__ import annotations

import dataclasses
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from nurec_sim.cli.console import app, chosen_device, err, out, print_table, progress
from nurec_sim.cli.inputs import PosesName, with_poses
from nurec_sim.cli.scenes import NO_FLAGS, MethodName, NetworkFlags, method_settings, refinement
from nurec_sim.errors import NurecSimError
from nurec_sim.files.new_files import check_writable, write_file
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.types import ActorsName

if TYPE_CHECKING:
    from nurec_sim.cli.progress import Report
    from nurec_sim.types import Clip

ProtocolName = Literal["storm", "clip", "shift", "lidar", "detection"]
USUAL_METHODS: dict[str, tuple[str, ...]] = {
    "storm": ("dense", "dense-lidar", "selective", "lift", "copy"),
    "clip": ("dense", "dense-lidar", "dense-concatenated", "lift", "copy"),
    "shift": ("dense", "dense-lidar", "selective", "lift", "copy"),
    "lidar": ("lidar", "lift", "optimized"),
    "detection": ("dense", "selective", "lift", "optimized", "copy"),
}
USUAL_WORLDS = {"storm": 12, "clip": 3, "shift": 6, "lidar": 4, "detection": 6}


@dataclass(frozen=True)
class LogFlags:
    """One log, cameras and sweeps held out (without --protocol)."""

    method: MethodName = "lift"
    """CLIP: the method, as in `nurec-sim reconstruct`."""
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE"), tyro.conf.UseAppendAction] = ()
    """CLIP: a setting of the method, as in `nurec-sim reconstruct`: --set views.width_px=1280."""
    refine: float | None = None
    """CLIP: time budget in seconds for optimising the scene on its input images and sweeps."""
    budget: int | None = None
    """CLIP: the most static Gaussians of an optimised scene, as in `nurec-sim reconstruct`."""
    poses: PosesName = "recorded"
    """CLIP: poses of the log, or refined by its LiDAR (docs/log_formats.md)."""
    actors: ActorsName = "auto"
    """CLIP: actors of the reconstruction: the log's boxes (recorded), what moves in its sweeps (found), or none; auto:
    recorded, or found if there are no boxes. Scores are by the log's boxes in any case."""
    align_actors: bool = True
    """CLIP: correct tracks of moving objects by the LiDAR returns on them, as in `nurec-sim reconstruct`."""
    align_sweeps: bool = True
    """CLIP: correct beams and poses of the log by the planes that its sweeps share, and mountings of cameras, as in
    `nurec-sim reconstruct`; what is held out takes no part, and moves with the rest."""
    complete_actors: bool = True
    """CLIP: give actors that the sensors hardly saw a body of their class, as in `nurec-sim reconstruct`."""
    input_cameras: tuple[str, ...] = ()
    """CLIP: input cameras of the reconstruction; default: all."""
    target_cameras: tuple[str, ...] = ()
    """CLIP: target cameras for scoring; default: the input cameras."""
    hold_out_sweeps: int = 0
    """CLIP: hold out every N-th sweep and simulate it; 0 holds out none."""
    scene: Path | None = None
    """CLIP: score this scene archive of the log instead of a new reconstruction; what is held out here must not be what
    it was made from."""
    local: bool = False
    """CLIP: render in this process instead of through gRPC."""
    detector: bool = False
    """CLIP: also compare what a camera detector finds in recorded and in rendered images; it learnt in generated towns
    (docs/evaluation.md)."""
    images: Path | None = None
    """CLIP: also write rendered and recorded images side by side into this folder."""
    json: Path | None = None
    """CLIP: write all metrics to this JSON file."""


@dataclass(frozen=True)
class ProtocolFlags:
    """Compare methods on held-out procedural worlds or on logs (with --protocol)."""

    methods: tuple[str, ...] = ()
    """Protocol: methods to compare: dense, dense-lidar, dense-concatenated, selective, lidar, lidar-no-floor, lift,
    optimized, copy, or any other method that `nurec-sim reconstruct` accepts; default: those of the protocol."""
    worlds: int | None = None
    """Protocol: number of procedural worlds; default: 12 for storm, 3 for clip, 6 for shift and detection, 4 for
    lidar."""
    seed: int = 0
    """Protocol: seed of the first procedural world; the others follow consecutively."""
    clips: tuple[Path, ...] = ()
    """Protocol: recorded logs instead of procedural worlds."""
    boxes: bool = False
    """Protocol: give the methods the log's boxes of movable objects; the paper's network uses none. Without them,
    methods that read sweeps find what moves."""
    seconds: float = 10.0
    """Protocol: length of a clip, 2 to 20."""
    clip_cameras: Literal[1, 3] = 3
    """Protocol: cameras of a clip."""
    selective_checkpoint: Path | None = None
    """Protocol: weights of `selective`; --checkpoint is for `dense`."""
    out: Path = Path("evaluations")
    """Protocol: parent folder of run folders."""
    resume: Path | None = None
    """Protocol: resume this run folder; finished windows are kept."""


LogGroup = Annotated[LogFlags, tyro.conf.arg(name="")]
ProtocolGroup = Annotated[ProtocolFlags, tyro.conf.arg(name="")]
NO_LOG_FLAGS, NO_PROTOCOL_FLAGS = LogFlags(), ProtocolFlags()
NOT_OF_A_SCENE = ("--set", "--refine", "--budget")
"""Flags that say how to reconstruct."""


@app.command
def evaluate(
    clip: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[CLIP]")] = None,
    *,
    protocol: ProtocolName | None = None,
    hold_out_every: int | None = None,
    log: LogGroup = NO_LOG_FLAGS,
    side_by_side: ProtocolGroup = NO_PROTOCOL_FLAGS,
    network: NetworkFlags = NO_FLAGS,
) -> None:
    """Score the reconstruction of one log, or compare methods by a protocol (docs/evaluation.md).

    `evaluate CLIP` compares with the recording: images of target cameras, held-out LiDAR sweeps.
    `evaluate --protocol NAME` prints the paper's tables: `storm` is 2 s with four input frames (Table 1), `clip` a
    whole log through the chunked pipeline (Table 2), `shift` views at lateral offsets, `lidar` held-out sweeps of a
    Pandar128 on the path and beside it (Table 3), `detection` a camera detector on true and on rendered images, on
    the path and beside it. evaluations/latest has tables, contact sheets and report.html.

    Args:
        clip: a driving log (docs/log_formats.md).
        protocol: evaluation protocol.
        hold_out_every: hold out every N-th image of a log for scoring; default: none of CLIP, every second frame in
            protocol `clip`.
        log: options for one log.
        side_by_side: options for protocols.
        network: network settings (see `nurec-sim reconstruct --help`); --device also applies to rendering.
    """
    if protocol is None:
        _refuse(given(side_by_side, NO_PROTOCOL_FLAGS), "without --protocol")
        if clip is None:
            raise NurecSimError(
                "nothing to evaluate: give a clip, or --protocol storm, clip, shift, lidar or detection"
            )
        evaluate_log(clip, log, hold_out_every or 0, network)
        return
    _refuse(given(log, NO_LOG_FLAGS), "with --protocol")
    if clip is not None:
        raise NurecSimError(f"with --protocol, logs are given by --clips {clip}")
    evaluate_protocol(protocol, side_by_side, 2 if hold_out_every is None else hold_out_every, network)


def given(flags: Any, usual: Any) -> list[str]:
    """Names of the flags that differ from their default."""
    names = [field.name for field in dataclasses.fields(flags)]
    return ["--" + name.replace("_", "-") for name in names if getattr(flags, name) != getattr(usual, name)]


def _refuse(names: list[str], where: str) -> None:
    if names:
        raise NurecSimError(f"{', '.join(names)} cannot be used {where}")


def evaluate_log(path: Path, flags: LogFlags, hold_out_every: int, network: FeedForwardSettings) -> None:
    """Scores one method, or one finished scene, on one log.

    Args:
        path: the log.
        flags: options for one log.
        hold_out_every: hold out every N-th image; 0: none.
        network: network settings; its device also renders.
    """
    from nurec_sim import logs
    from nurec_sim.evaluate import evaluate as run_evaluation
    from nurec_sim.evaluate import figure_rows

    settings = method_settings(flags.method, network, flags.set, flags.refine, renders=True, budget=flags.budget)
    log = logs.open_clip(path)
    if flags.json is not None:
        check_writable(flags.json)
    if flags.images is not None:
        check_writable(flags.images, folder=True)
    device = chosen_device(network.device)
    if flags.scene is not None and (changed := [name for name in given(flags, NO_LOG_FLAGS) if name in NOT_OF_A_SCENE]):
        raise NurecSimError(f"{', '.join(changed)}: for a new reconstruction, and --scene is a finished one")
    log = with_poses(log, flags.poses)
    with progress("evaluating") as advance:
        if flags.scene is not None:
            figures = _score_archive(log, flags, hold_out_every, device, advance)
        else:
            figures = run_evaluation(
                log,
                flags.method,
                input_cameras=flags.input_cameras or None,
                target_cameras=flags.target_cameras or None,
                hold_out_every=hold_out_every,
                hold_out_sweeps_every=flags.hold_out_sweeps,
                via_grpc=not flags.local,
                device=device,
                images_dir=flags.images,
                detector=flags.detector,
                progress=advance,
                settings=settings,
                refine=refinement(flags.refine, device, flags.budget),
                actors=flags.actors,
                align_actors=flags.align_actors,
                align_sweeps=flags.align_sweeps,
                complete_actors=flags.complete_actors,
            )
    if flags.json is not None:
        write_file(flags.json, json.dumps(figures, indent=1, sort_keys=True) + "\n")
    title = flags.method if flags.scene is None else flags.scene.name
    group = ""
    for row in figure_rows(figures):
        if row.group != group:
            group = row.group
            print_table(
                f"{title} on {log.id}. {group}", [(r.name, r.text) for r in figure_rows(figures) if r.group == group]
            )
    if detection := figures.get("detection"):
        out.print(str(detection.get("caveat") or f"The detector: {detection['not_known']}."), style="dim", markup=False)


def _score_archive(log: Clip, flags: LogFlags, hold_out_every: int, device: str, advance: Report) -> dict[str, Any]:
    from nurec_sim.evaluate import score_scene
    from nurec_sim.logs import hold_out
    from nurec_sim.scene import read_scene

    assert flags.scene is not None
    scene = read_scene(flags.scene)
    cameras = [name for name in scene.provenance.get("cameras", scene.rig.cameras) if name in log.rig.cameras]
    return score_scene(
        log,
        scene,
        hold_out(log, cameras, images_every=hold_out_every, sweeps_every=flags.hold_out_sweeps),
        target_cameras=flags.target_cameras or None,
        via_grpc=not flags.local,
        device=device,
        images_dir=flags.images,
        detector=flags.detector,
        progress=advance,
    )


def evaluate_protocol(
    name: ProtocolName, flags: ProtocolFlags, hold_out_every: int, network: FeedForwardSettings
) -> None:
    """Compares methods, prints the tables and writes a run folder.

    Args:
        name: the protocol.
        flags: options for protocols.
        hold_out_every: hold out every N-th frame in protocol ``clip``.
        network: network settings; its device also renders.
    """
    if flags.clips and (flags.worlds is not None or flags.seed):
        raise NurecSimError("--worlds and --seed select procedural worlds, --clips recorded logs; give one of the two")
    from nurec_sim.evaluate import Protocol, contenders, run_protocol
    from nurec_sim.evaluate.methods import without_weights
    from nurec_sim.evaluate.run import settings_of
    from nurec_sim.evaluate.tables import tables
    from nurec_sim.runs.folder import existing_run_folder, new_run_folder

    started = time.monotonic()
    worlds = USUAL_WORLDS[name] if flags.worlds is None else flags.worlds
    protocol = Protocol(
        name,
        () if flags.clips else tuple(range(flags.seed, flags.seed + worlds)),
        tuple(path.resolve() for path in flags.clips),
        boxes=flags.boxes,
        seconds=flags.seconds,
        hold_out_every=hold_out_every,
        cameras=flags.clip_cameras,
    )
    methods = contenders(flags.methods or USUAL_METHODS[name], network, flags.selective_checkpoint)
    if not flags.methods:
        missing = {method: why for method in methods if (why := without_weights(method)) is not None}
        methods = tuple(method for method in methods if method not in missing)
        for method, why in missing.items():
            err.print(f"note: {method.name} is skipped: {why}", style="yellow", markup=False, soft_wrap=True)
    settings_of(protocol, methods)  # fails on missing weights before a folder is created
    stamp = time.strftime("%Y-%m-%d_%H-%M-%S")
    folder = new_run_folder(flags.out, stamp) if flags.resume is None else existing_run_folder(flags.resume)
    device = chosen_device(network.device)
    with progress("evaluating") as advance:
        results = run_protocol(protocol, methods, folder, advance, device)
    for table in tables(results):
        print_table(table.title, table.rows, table.heading)
        if table.note:
            out.print(table.note, style="dim", markup=False)
    out.print(f"{time.monotonic() - started:.0f} s. Report: {folder / 'report.html'}", soft_wrap=True)
