"""The protocols: windows, inputs and targets.

``storm``  2 s at 10 Hz; frames 0, 5, 10 and 15 are inputs, the other 16 targets (paper section 5.1, Table 1).
``clip``   a whole log through the chunked pipeline; every k-th frame is a target, the rest are inputs (Table 2).
``shift``  as ``storm``, but with targets at lateral offsets, in procedural worlds only.
``lidar``  as ``shift``, but the targets are sweeps of a ``SCANNER`` that are held out (Table 3).
``detection``  as ``shift``, 1 and 2 m beside the path, with a camera detector on true and on rendered images.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np

from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate.procedural import EvaluationWorld, camera_responses, evaluation_rig, held_out_plan
from nurec_sim.evaluate.windows import EvaluationView, Window
from nurec_sim.logs.selection import ContextClip
from nurec_sim.world import Quality, TrueWorld

PROTOCOLS = ("storm", "clip", "shift", "lidar", "detection")
ProtocolName = Literal["storm", "clip", "shift", "lidar", "detection"]

STEP_US = 100_000
STORM_FRAMES, STORM_CONTEXT = 20, (0, 5, 10, 15)
START_S = 1.0
"""Start of windows after the start of their world."""
SHIFTS_M = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5)
DETECTION_SHIFTS_M = (1.0, 2.0)
SHIFT_FRAMES = (3, 8, 13)
"""Target frames for lateral offsets: each about halfway between two input frames."""
SCANNER, SWEEP_SHIFTS_M = "PANDAR128", (1.0, 2.0, 3.0)
"""The LiDAR of the paper's section on LiDAR, and the lateral offsets at which its sweeps are simulated."""
NEAR_M, NEAR_SHARE = 1.0, 0.2
"""A sensor with more than this fraction of pixels or returns nearer than this is inside an object."""
QUALITY = Quality(lidar="rasterised")

Progress = Callable[[str, float], None]


class Made(NamedTuple):
    """Input log, target views, and logs of target sweeps by lateral offset."""

    clip: ContextClip
    targets: list[EvaluationView]
    beside: Mapping[float, ContextClip] = MappingProxyType({})


@dataclass(frozen=True)
class Protocol:
    """A protocol with its settings; equal protocols give equal windows.

    Attributes:
        name: one of ``PROTOCOLS``.
        seeds: of the procedural worlds.
        clips: recorded logs to use instead; ``size_px``, ``seconds`` and ``backend`` do not apply to them.
        boxes: whether the methods get the boxes of movable objects.
        size_px: width and height of the images.
        seconds: length of a ``clip``.
        rate_hz: frames per second of a ``clip``.
        hold_out_every: target frames of a ``clip``: k - 1, 2k - 1, ...
        cameras: of a ``clip``: 1 or 3.
        backend: of ``TrueWorld``.
    """

    name: ProtocolName
    seeds: tuple[int, ...] = ()
    clips: tuple[Path, ...] = ()
    boxes: bool = False
    size_px: tuple[int, int] = (480, 320)
    seconds: float = 10.0
    rate_hz: float = 4.0
    hold_out_every: int = 2
    cameras: int = 3
    backend: str | None = None

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            ReconstructError: a value out of range.
        """
        if self.name not in PROTOCOLS:
            raise ReconstructError(f"no protocol {self.name!r}; have {list(PROTOCOLS)}")
        if bool(self.seeds) == bool(self.clips):
            raise ReconstructError("a protocol runs on procedural worlds or on recorded logs: give seeds or clips")
        if min(self.seeds, default=0) < 0 or len(set(self.seeds)) < len(self.seeds):
            raise ReconstructError(f"seeds must not be negative, and each may be given once, got {self.seeds}")
        if self.clips and self.name in ("shift", "lidar", "detection"):
            raise ReconstructError(
                f"protocol {self.name!r} needs procedural worlds: logs have no sensors at lateral offsets"
            )
        if not 2 <= self.seconds <= 20 or not 1 <= self.rate_hz <= 10 or self.hold_out_every < 2:
            raise ReconstructError(
                "a clip lasts 2..20 seconds at 1..10 Hz and holds out every second frame or fewer, got "
                f"{self.seconds:g} s, {self.rate_hz:g} Hz, every {self.hold_out_every}"
            )
        if self.cameras not in (1, 3):
            raise ReconstructError(f"a clip has 1 or 3 cameras, got {self.cameras}")

    @cached_property
    def ids(self) -> tuple[str, ...]:
        """Names of the windows, in order."""
        return tuple(f"{self.name}-{seed}" for seed in self.seeds) or tuple(self._recorded)

    @cached_property
    def _recorded(self) -> dict[str, Callable[[], Window]]:
        """Windows of the recorded logs by their names."""
        from nurec_sim.evaluate.recorded import clip_window, storm_windows
        from nurec_sim.logs import open_clip

        found: dict[str, Callable[[], Window]] = {}
        for path in self.clips:
            clip = open_clip(path)
            if self.name == "storm":
                new = storm_windows(clip, STORM_FRAMES, STORM_CONTEXT, STEP_US, self.boxes)
            else:
                new = clip_window(clip, self.cameras, self.hold_out_every, self.boxes)
            if found.keys() & new.keys():
                raise ReconstructError(f"two logs have the id {clip.id!r}; give each once")
            found |= new
        return found

    @contextlib.contextmanager
    def window(self, index: int, progress: Progress | None = None) -> Iterator[Window]:
        """Generates or reads one window, valid until the block ends."""
        report, name = progress or (lambda stage, fraction: None), self.ids[index]
        if self.clips:
            report("reading the log", 0.0)
            yield self._recorded[name]()
            return
        report("building the world", 0.0)
        long_s = self.seconds if self.name == "clip" else STORM_FRAMES * STEP_US / 1e6
        plan = held_out_plan(self.seeds[index], long_s + START_S + 0.5)
        scanner = SCANNER if self.name == "lidar" else None
        rig = evaluation_rig(self.cameras if self.name == "clip" else 1, *self.size_px, lidar=scanner)
        responses = camera_responses(rig, plan.seed) if self.name == "clip" else {}
        with TrueWorld(plan, self.backend, responses, QUALITY) as world:
            source = EvaluationWorld(world, rig)
            report("rendering", 0.1)
            made = _MAKERS[self.name](self, source, name, plan.span_us[0] + round(START_S * 1e6), report)
            yield Window(name, made.clip, tuple(made.targets), _about(source, made.clip.span_us), made.beside)


def _storm(protocol: Protocol, source: EvaluationWorld, id: str, start_us: int, report: Progress) -> Made:
    times, span_us = _storm_times(start_us)
    clip = source.clip(id, times[list(STORM_CONTEXT)], span_us, protocol.boxes)
    camera = next(iter(source.rig.cameras))
    targets = []
    for frame in range(STORM_FRAMES):
        report("rendering", 0.1 + 0.9 * frame / STORM_FRAMES)
        if frame not in STORM_CONTEXT:
            beyond = frame > STORM_CONTEXT[-1]
            targets.append(source.target(f"{frame:02d}", camera, int(times[frame]), beyond=beyond))
    return Made(clip, targets)


def _shift(protocol: Protocol, source: EvaluationWorld, id: str, start_us: int, report: Progress) -> Made:
    return _beside(protocol, source, id, start_us, report, SHIFTS_M)


def _detection(protocol: Protocol, source: EvaluationWorld, id: str, start_us: int, report: Progress) -> Made:
    return _beside(protocol, source, id, start_us, report, DETECTION_SHIFTS_M, sight=True)


def _beside(
    protocol: Protocol, source: EvaluationWorld, id: str, start_us: int, report: Progress, shifts_m: Sequence[float],
    sight: bool = False,
) -> Made:  # fmt: skip
    """Targets on the path and on both sides of it."""
    times, span_us = _storm_times(start_us)
    clip = source.clip(id, times[list(STORM_CONTEXT)], span_us, protocol.boxes)
    camera = next(iter(source.rig.cameras))
    inputs = [] if sight else [source.image(camera, int(times[frame])) for frame in STORM_CONTEXT]
    places = [0.0, *(side * shift for shift in shifts_m for side in (1, -1))]
    targets = []
    for count, left_m in enumerate(places):
        report("rendering", 0.1 + 0.9 * count / len(places))
        for frame in SHIFT_FRAMES:
            target = source.target(
                f"{frame:02d}{left_m:+.1f}", camera, int(times[frame]), left_m, sight=sight, inputs=inputs
            )
            if not _inside_something(target):
                targets.append(target)
    return Made(clip, targets)


def _clip(protocol: Protocol, source: EvaluationWorld, id: str, start_us: int, report: Progress) -> Made:
    count = int(protocol.seconds * protocol.rate_hz)
    times = start_us + np.rint(np.arange(count) * 1e6 / protocol.rate_hz).astype(np.int64)
    asked = list(range(protocol.hold_out_every - 1, count, protocol.hold_out_every))
    seen = sorted(set(range(count)) - set(asked))
    span_us = (start_us, start_us + round(protocol.seconds * 1e6))
    clip = source.clip(id, times[seen], span_us, protocol.boxes)
    targets = []
    for number, frame in enumerate(asked):
        report("rendering", 0.1 + 0.9 * number / len(asked))
        for camera in source.rig.cameras:
            beyond = frame > seen[-1]
            targets.append(source.target(f"{camera}-{frame:03d}", camera, int(times[frame]), beyond=beyond))
    return Made(clip, targets)


def _lidar(protocol: Protocol, source: EvaluationWorld, id: str, start_us: int, report: Progress) -> Made:
    times, span_us = _storm_times(start_us)
    none = times[:0]
    clip = source.clip(id, times[list(STORM_CONTEXT)], span_us, protocol.boxes, lambda k: k not in SHIFT_FRAMES)
    beside = {}
    for left_m in (0.0, *(side * shift for shift in SWEEP_SHIFTS_M for side in (1, -1))):
        driven = EvaluationWorld(source.world, source.rig, left_m)
        beside[left_m] = driven.clip(id, none, span_us, protocol.boxes, lambda k: k in SHIFT_FRAMES)
        report("scanning", 0.1 + 0.9 * len(beside) / (2 * len(SWEEP_SHIFTS_M) + 1))
        beside[left_m] = _with_free_sensor(beside[left_m])
    return Made(clip, [], beside)


def _with_free_sensor(clip: ContextClip) -> ContextClip:
    """The log without sweeps from inside or right in front of an object."""
    free = {
        lidar: tuple(
            turn for turn in turns if np.mean(np.linalg.norm(turn.sweep().xyz_m, axis=1) < NEAR_M) <= NEAR_SHARE
        )
        for lidar, turns in clip.revolutions.items()
    }
    return replace(clip, revolutions=free)


_MAKERS: dict[ProtocolName, Callable[[Protocol, EvaluationWorld, str, int, Progress], Made]] = {
    "storm": _storm,
    "shift": _shift,
    "clip": _clip,
    "lidar": _lidar,
    "detection": _detection,
}


def _storm_times(start_us: int) -> tuple[np.ndarray, tuple[int, int]]:
    return start_us + STEP_US * np.arange(STORM_FRAMES), (start_us, start_us + STORM_FRAMES * STEP_US)


def _inside_something(target: EvaluationView) -> bool:
    """Whether a shifted view is inside or right in front of an object."""
    depth_m = target.true.depth_m
    return depth_m is not None and float(((depth_m > 0) & (depth_m < NEAR_M)).mean()) > NEAR_SHARE


def _about(source: EvaluationWorld, span_us: tuple[int, int]) -> dict[str, str | int | float]:
    """Description of a window in plain JSON."""
    plan, ends = source.world.plan, source.ego.at(np.array(span_us))[:, :3, 3]
    return {
        "seed": plan.seed,
        "split": plan.split,
        "template": plan.template,
        "sky": plan.weather.preset,
        "driven_m": round(float(np.linalg.norm(ends[1] - ends[0])), 2),
        "plan": hashlib.sha256(plan.to_json().encode()).hexdigest()[:12],
        "drawn_by": source.world.backend,
    }
