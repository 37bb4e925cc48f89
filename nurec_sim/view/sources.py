"""What can be opened: scene archives, logs, run folders, and scenes of a running server."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from nurec_sim.errors import ArchiveError, NurecSimError, RequestError, RunError, UnknownFormatError
from nurec_sim.logs import Clip, open_clip
from nurec_sim.render.device import Renderer
from nurec_sim.render.images.still import Layer
from nurec_sim.render.support import recorded_frames
from nurec_sim.runs.folder import ROLLOUT, rollout_folders
from nurec_sim.runs.rollout_file import load_rollout
from nurec_sim.runs.scene_file import load_scene_record, reconstruction_of
from nurec_sim.scene import scene_hash
from nurec_sim.serving.client import RemoteSensors
from nurec_sim.serving.store import LoadedScene, SceneStore, default_cache_dir
from nurec_sim.serving.store.sources import is_archive
from nurec_sim.types import GaussianScene, Rig, Rollout, SensorFrame, SensorRequest, Track, Trajectory

LAYERS: tuple[Layer, ...] = ("rgb", "depth", "alpha", "label", "normal")
"""Of a scene in this process; ``support`` comes with them where it is known when the cameras recorded."""
SAME_PLACE_M = 5.0
"""Paths of two reconstructions of one log differ by less: refined poses move by a metre or two."""
MOST_NAMED = 5
_ADDRESS = re.compile(r"(?P<server>[\w.-]+:\d+|\[[0-9a-fA-F:]+\]:\d+)(/(?P<scene>.+))?")

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class World:
    """One scene that can be looked at.

    ``sense`` renders requests with the outputs that are named, of those in ``layers``. ``times_us`` are the first and
    the last time that can be rendered. ``scene`` and ``renderer`` are None if it is on a server.
    """

    name: str
    id: str
    rig: Rig
    ego: Trajectory
    tracks: Sequence[Track]
    times_us: tuple[int, int]
    layers: tuple[Layer, ...]
    sense: Callable[[Sequence[SensorRequest], Sequence[str]], list[SensorFrame]]
    camera_times_us: Mapping[str, Int64[np.ndarray, "frames 2"]] = field(default_factory=dict)
    scene: GaussianScene | None = None
    renderer: Renderer | None = None


@dataclass(frozen=True, eq=False)
class Opened:
    """All that a viewer shows: worlds (at least one), a log with recorded images, rollouts by name."""

    worlds: tuple[World, ...]
    clip: Clip | None = None
    rollouts: Mapping[str, Rollout] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def world_of(self, rollout: Rollout) -> int:
        """Index of the world that a rollout was driven in; the first if it is not among them."""
        for index, world in enumerate(self.worlds):
            if world.scene is not None and reconstruction_of(world.scene) == rollout.reconstruction:
                return index
        return 0


def open_sources(
    sources: Sequence[str | Path],
    clip: Path | None = None,
    *,
    device: str = "auto",
    threads: int | None = None,
    cache_dir: Path | None = None,
    progress: Progress | None = None,
    stack: contextlib.ExitStack,
) -> Opened:
    """Opens everything that is to be viewed together.

    Args:
        sources: scene archives, logs (reconstructed with ``lift`` and cached), one run folder, and scenes of servers as
            HOST:PORT or HOST:PORT/SCENE.
        clip: the log whose recorded images are shown beside the rendered ones; the first log among the sources if None.
        device: rendering device of scenes in this process; see ``render.choose_device``.
        threads: CPU threads that work on a frame; all cores if None.
        cache_dir: where reconstructed logs are kept.
        progress: called with the stage and the fraction done.
        stack: closes connections to servers.

    Raises:
        NurecSimError: one cannot be opened, or they do not belong to one log; the text names it.
    """
    say = progress or (lambda stage, fraction: None)
    runs = [Path(source) for source in sources if _is_run(Path(source))]
    others = [source for source in sources if Path(source) not in runs]
    if len(runs) > 1:
        raise RunError(f"the viewer shows one run at a time, got {len(runs)}: {', '.join(map(str, runs))}")
    rollouts = _rollouts(runs[0]) if runs else {}
    notes: list[str] = []
    if runs and not others:
        others = [*_kept_scenes(runs[0], cache_dir or default_cache_dir())]
    store = SceneStore(device=device, threads=threads, cache_dir=cache_dir, capacity=max(len(others), 1))
    worlds: list[World] = []
    for index, source in enumerate(others):
        say(f"loading {source}", index / len(others))
        address = None if Path(source).exists() else _ADDRESS.fullmatch(str(source))
        if address:
            worlds.append(_remote(address["server"], address["scene"], stack))
            continue
        try:
            name = store.offer(Path(source), name=f"source {index}")
        except UnknownFormatError:
            raise RequestError(_not_viewable(Path(source))) from None
        worlds.append(local_world(store.get(name, say)))
        if clip is None and not is_archive(Path(source)):
            clip = Path(source)
    if not worlds:
        raise NurecSimError("nothing to view: give scene archives, logs, a run folder, or HOST:PORT of a server")
    _check_one_log(worlds)
    log = None if clip is None else open_clip(clip)
    if log is not None and (log.span_us[0] > worlds[0].times_us[1] or log.span_us[1] <= worlds[0].times_us[0]):
        raise RequestError(
            f"clip {log.id!r} covers {log.span_us} us and scene {worlds[0].id!r} {worlds[0].times_us}: "
            "they are not of one log"
        )
    if runs and not any(_drove_in(rollout, world) for rollout in rollouts.values() for world in worlds):
        first = next(iter(rollouts.values()))
        notes.append(
            f"the run was driven in scene {first.scene_id!r} ({first.reconstruction}), which is not among those given"
        )
    return Opened(_named(worlds), log, rollouts, tuple(notes))


def _not_viewable(path: Path) -> str:
    """What the viewer takes, and what of that lies in a folder."""
    told = f"{path} is nothing to view: give scene archives (.usdz), logs (docs/log_formats.md), "
    told += "a run folder (such as runs/latest), or HOST:PORT of a server"
    within = sorted(path.iterdir()) if path.is_dir() else []
    able = [each for each in within if is_archive(each) or _is_run(each)]
    if able:
        more = " and others" if len(able) > MOST_NAMED else ""
        told += f". In it: {', '.join(map(str, able[:MOST_NAMED]))}{more}"
    return told


def local_world(loaded: LoadedScene) -> World:
    """A scene that is rendered in this process."""
    scene = loaded.scene
    return World(
        name=reconstruction_of(scene),
        id=scene.id,
        rig=scene.rig,
        ego=scene.ego,
        tracks=scene.tracks,
        times_us=scene.span_us,
        layers=(*LAYERS, "support") if recorded_frames(scene) else LAYERS,
        sense=loaded.renderer.sense,
        camera_times_us=scene.camera_times_us,
        scene=scene,
        renderer=loaded.renderer,
    )


def _remote(server: str, scene_id: str | None, stack: contextlib.ExitStack) -> World:
    with RemoteSensors(server) as any_scene:
        have = any_scene.scenes()
    if scene_id is None and len(have) != 1:
        raise RequestError(f"{server} serves {len(have)} scenes: choose with {server}/SCENE; have {have[:20]}")
    scene_id = scene_id or have[0]
    remote = stack.enter_context(RemoteSensors(server, scene_id))
    ego = remote.trajectory()
    return World(
        name=f"{server}/{scene_id}",
        id=scene_id,
        rig=Rig(remote.cameras(), remote.lidars()),
        ego=ego,
        tracks=remote.tracks(),
        times_us=(ego.start_us, ego.end_us),
        layers=("rgb",),
        sense=lambda requests, outputs: remote.sense(requests),
    )


def _is_run(path: Path) -> bool:
    return path.is_dir() and bool(rollout_folders(path))


def _rollouts(run: Path) -> dict[str, Rollout]:
    """The rollouts of a run that have states, by policy, reconstruction and seed."""
    loaded = [load_rollout(folder / ROLLOUT) for folder in rollout_folders(run)]
    driven = [rollout for rollout in loaded if rollout.states]
    scenes = {rollout.scene_id for rollout in driven}
    if len(scenes) > 1:  # a viewer shows one log
        driven = [rollout for rollout in driven if rollout.scene_id == driven[0].scene_id]
    if not driven:
        raise RunError(f"run folder {run} has no rollout with states")
    return {f"{each.policy}, {each.reconstruction}, seed {each.seed}": each for each in driven}


def _kept_scenes(run: Path, cache_dir: Path) -> list[Path]:
    """Archives among the cached reconstructions in which a run was driven.

    Raises:
        RunError: there is none.
    """
    found, missing = [], []
    for folder in dict.fromkeys(place.parent.parent for place in rollout_folders(run)):
        record = load_scene_record(folder)
        for path in sorted(cache_dir.glob(f"*-{record.reconstruction}-*.usdz"), key=_age):
            with contextlib.suppress(ArchiveError):
                from nurec_sim.scene import read_scene

                if scene_hash(read_scene(path)) == record.sha256:
                    found.append(path)
                    break
        else:
            missing.append(f"{record.id!r} ({record.reconstruction})")
    if not found:
        raise RunError(
            f"{run} was driven in scene {', '.join(missing)}, which is not among the cached reconstructions; give its "
            f"archive or its log too: nurec-sim view {run} SCENE.usdz"
        )
    return found


def _age(path: Path) -> float:
    return -path.stat().st_mtime


def _drove_in(rollout: Rollout, world: World) -> bool:
    return world.scene is None or (world.id, world.name) == (rollout.scene_id, rollout.reconstruction)


def _check_one_log(worlds: Sequence[World]) -> None:
    """Raises if scenes cannot be compared.

    Raises:
        RequestError: times or places have nothing in common.
    """
    first = worlds[0]
    for other in worlds[1:]:
        start, end = max(first.times_us[0], other.times_us[0]), min(first.times_us[1], other.times_us[1])
        apart = float("inf")
        if start <= end:
            middle = (start + end) // 2
            apart = float(np.linalg.norm((first.ego.at(middle) - other.ego.at(middle))[:3, 3]))
        if apart > SAME_PLACE_M:
            raise RequestError(
                f"{first.id!r} and {other.id!r} are not reconstructions of one log: they cover {first.times_us} and "
                f"{other.times_us} us" + (f", and their cars are {apart:.1f} m apart" if start <= end else "")
            )


def _named(worlds: Sequence[World]) -> tuple[World, ...]:
    """Worlds with different names."""
    from dataclasses import replace

    names = [world.name for world in worlds]
    return tuple(
        replace(world, name=f"{world.name} {index + 1}") if names.count(world.name) > 1 else world
        for index, world in enumerate(worlds)
    )
