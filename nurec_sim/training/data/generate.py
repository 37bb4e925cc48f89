"""Generation of training clips: a procedural town by its seed, driven through several times with random rigs.

Clips are determined by the town's number and the settings, and reproducible on the same machine.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from nurec_sim.training.data.clips import FARTHEST_M, NORMAL_SCALE, CameraRecord, write_training_clip
from nurec_sim.types import CameraModel, Rig, SensorRequest, Shutter, Track, Trajectory

if TYPE_CHECKING:
    from nurec_sim.world import TrueWorld

GENERATOR = 3
"""Version, to be raised when the same settings would give different clips, so that old and new ones are not mixed."""
CAMERAS = {1: 0.4, 3: 0.5, 5: 0.1}
"""Probability of each number of cameras of a rig."""
PLAIN_LENS, GLOBAL_SHUTTER = 0.6, 0.85
"""Probabilities that a rig is given pinholes without distortion, and a global shutter: other lenses cost twice,
rolling shutters about four times as much to render."""
SAMPLES_AND_SHADOW = 2, 1024
"""Colour samples per pixel and size of the shadow map, half of what logs are rendered with."""
TOGETHER = 0.5
"""Probability that all cameras of a rig expose simultaneously; otherwise each has its own delay."""
MOST_DELAY_US, LONGEST_READOUT_US = 90_000, 33_000
"""Maximum delay between the ends of exposure of two cameras; maximum readout time of a rolling shutter."""
KNOT_MARGIN_US = 2_000_000
"""Time before and after a clip for which tracks are kept: motion decoders are evaluated outside of it."""


@dataclass(frozen=True)
class ClipSettings:
    """Settings of training clips.

    Attributes:
        split: towns for training (``train``), or held-out ones (``test``).
        frames: frames of every camera.
        period_us: frame interval.
        pixels: approximate number of pixels per image; more than the network takes, to leave room for random crops.
        clips_per_town: drives through each town; building a town costs as much as about twenty images.
        seconds: simulated traffic in each town.
    """

    split: Literal["train", "test"] = "train"
    frames: int = 24
    period_us: int = 100_000
    pixels: int = 65_856
    clips_per_town: int = 3
    seconds: float = 12.0

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            ValueError: fewer than 2 frames, images too small, or drives longer than the traffic lasts.
        """
        if self.frames < 2 or self.period_us < 1 or self.clips_per_town < 1 or self.pixels < 64 * 14**2:
            raise ValueError(f"a training clip needs 2 frames, a period, 12544 pixels and one drive a town, got {self}")
        if self._length_us + MOST_DELAY_US > self.seconds * 1e6:
            raise ValueError(f"{self.frames} frames every {self.period_us} us do not fit into {self.seconds} s")

    @property
    def _length_us(self) -> int:
        return self.frames * self.period_us

    @property
    def hash(self) -> str:
        """12 hexadecimal digits that identify these settings and the version of the generator."""
        text = json.dumps({"generator": GENERATOR, **dataclasses.asdict(self)}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def clip_ids(town: int, settings: ClipSettings) -> list[str]:
    """Names of the clips of a town."""
    return [f"{settings.split}-{town:06d}-{drive}" for drive in range(settings.clips_per_town)]


def town_of(clip_id: str) -> int:
    """The town that a clip was generated in.

    Raises:
        ValueError: not the name of a clip.
    """
    return int(clip_id.split("-")[1])


def generate_town(town: int, settings: ClipSettings, folder: Path, backend: str | None = None) -> Iterator[Path]:
    """Generates the missing clips of a town, one after the other.

    Args:
        town: number (seed) of the town.
        settings: settings of the clips.
        folder: folder of the clips; those that exist already are skipped.
        backend: rendering back end, see ``world.pick_backend``.

    Yields:
        the folder of each new clip.

    Raises:
        ValueError: ``town`` is negative.
        RuntimeError: ``backend`` does not work here (``world.pick_backend``).
    """
    from nurec_sim.world import TrueWorld, town_plan
    from nurec_sim.world.sense.stage import Quality

    missing = [(drive, name) for drive, name in enumerate(clip_ids(town, settings)) if not (folder / name).is_dir()]
    if not missing:
        return
    plan = town_plan(town, settings.split, seconds=settings.seconds)
    plan_sha256 = hashlib.sha256(plan.to_json().encode()).hexdigest()
    facts = {"town": town, "split": settings.split, "plan_sha256": plan_sha256, "generator": GENERATOR,
             "settings": dataclasses.asdict(settings)}  # fmt: skip
    with TrueWorld(plan, backend, quality=Quality(*SAMPLES_AND_SHADOW)) as world:
        for drive, name in missing:
            yield _draw_clip(world, drive, settings, folder / name, {**facts, "drive": drive})


def _draw_clip(world: TrueWorld, drive: int, settings: ClipSettings, folder: Path, facts: dict) -> Path:
    from nurec_sim.world import random_readout_us, random_rig
    from nurec_sim.world.plan.splits import STREAM_OF_SPLIT

    plan = world.plan
    rng = np.random.default_rng([plan.seed, drive, STREAM_OF_SPLIT[plan.split]])
    count, car = int(rng.choice(list(CAMERAS), p=list(CAMERAS.values()))), int(rng.integers(1 << 31))
    lens = "pinhole" if rng.random() < PLAIN_LENS else None
    rig, readout_us = random_rig(car, count, settings.pixels, lens, None), random_readout_us(car)
    at_once = rng.random() < GLOBAL_SHUTTER
    ego = plan.ego_trajectory()
    # The drives share the town's time evenly, each starting at a random instant of its part.
    free_us = plan.span_us[1] - plan.span_us[0] - settings.frames * settings.period_us - MOST_DELAY_US
    start_us = plan.span_us[0] + int(free_us * (drive + rng.random()) / settings.clips_per_town)
    together = rng.random() < TOGETHER
    records = []
    cameras = [dataclasses.replace(c, shutter=Shutter.GLOBAL) if at_once else c for c in rig.cameras.values()]
    for camera in cameras:
        delay_us = 0 if together else int(rng.integers(MOST_DELAY_US - LONGEST_READOUT_US))
        first = start_us + delay_us + settings.period_us * np.arange(settings.frames, dtype=np.int64)
        last = first if camera.shutter is Shutter.GLOBAL else first + readout_us
        records.append(_record(world, camera, ego, np.stack([first, last], axis=1)))
    span_us = (min(int(r.t_us.min()) for r in records), max(int(r.t_us.max()) for r in records))
    tracks = [dataclasses.replace(track, path=_cut(track, span_us)) for track in plan.tracks()]
    rig = Rig({camera.id: camera for camera in cameras}, {}, rig.body)
    return write_training_clip(folder, rig, ego, tracks, records, facts)


def _record(world: TrueWorld, camera: CameraModel, ego: Trajectory, exposures: np.ndarray) -> CameraRecord:
    from nurec_sim.world import LABEL_OF_CLASS

    poses = ego.at(exposures.reshape(-1)).reshape(-1, 2, 4, 4) @ camera.rig_from_camera
    size = (len(exposures), camera.height_px, camera.width_px)
    record = CameraRecord(
        exposures, poses, np.empty((*size, 3), np.uint8), np.empty(size, np.uint8), np.empty(size, np.float16),
        np.empty((*size, 3), np.int8), np.empty(size, np.uint16),
    )  # fmt: skip
    for index, ((start_us, end_us), pair) in enumerate(zip(exposures.tolist(), poses, strict=True)):
        view = world.view(SensorRequest("", camera, start_us, end_us, pair))
        record.rgb[index], record.instance[index] = view.rgb, view.instance
        record.label[index] = LABEL_OF_CLASS[view.surface]
        record.depth[index] = np.where(view.depth_m <= FARTHEST_M, view.depth_m, 0)
        record.normal[index] = np.rint(view.normal * NORMAL_SCALE)
    return record


def _cut(track: Track, span_us: tuple[int, int]) -> Trajectory:
    """The part of a track's path around a clip; knots are kept unchanged."""
    times = track.path.t_us
    low = max(int(np.searchsorted(times, span_us[0] - KNOT_MARGIN_US, side="right")) - 1, 0)
    high = int(np.searchsorted(times, span_us[1] + KNOT_MARGIN_US, side="left")) + 1
    return Trajectory(times[low:high], track.path.world_from_body[low:high])
