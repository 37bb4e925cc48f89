"""Places in training towns: one sweep as input, and the same instant seen from other poses.

Everything about a place follows from its town, its number and the settings. Places are kept on disk (``.npz``), named
by the hash of the settings, so that runs share them.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from nurec_sim import geometry
from nurec_sim.errors import TrainingError
from nurec_sim.files.new_files import write_file
from nurec_sim.sensors import lidar_model
from nurec_sim.training.lidar.config import ScanSettings
from nurec_sim.types import LidarModel, SensorRequest
from nurec_sim.world import LABEL_OF_CLASS, LidarResponse, Quality, TrueScan, TrueWorld, town_plan

GENERATOR = 1
"""Version, to be raised when the same settings would give other sweeps."""
SCANNERS = {"PANDAR128": 0.5, "HDL-64": 0.2, "VLP-32C": 0.1, "HDL-32": 0.1, "AT128": 0.1}
"""Probability of each device."""
HEIGHT_M = (1.5, 2.2)
COLUMNS = 1800
DROPS = 0.6
"""Probability that a place's sweeps lose beams; otherwise every beam that meets something returns."""
SPIN_US, MARGIN_US = 100_000, 500_000
TOWN_S = 8.0
"""Simulated traffic of each town."""
LOSSY = "lossy"
"""Id of the same device in towns, when it loses beams."""


@dataclass(frozen=True, eq=False)
class Scans:
    """A place: sweeps of one device at one instant, the input first.

    Attributes:
        lidar: the device.
        world_from_lidar: poses at the start and the end of each sweep.
        range_m: of the surface that each beam meets, 0 where there is none.
        intensity: of its return.
        label: its ``types.Label``.
        lost: beams that do not return although they meet a surface.
        noise_m: errors of the ranges that the input sweep measures.
    """

    lidar: LidarModel
    world_from_lidar: Float64[np.ndarray, "sweeps 2 4 4"]
    range_m: Float32[np.ndarray, "sweeps rows columns"]
    intensity: Float32[np.ndarray, "sweeps rows columns"]
    label: UInt8[np.ndarray, "sweeps rows columns"]
    lost: Bool[np.ndarray, "sweeps rows columns"]
    noise_m: Float32[np.ndarray, "rows columns"]


def place_names(settings: ScanSettings) -> list[str]:
    """Names of the files of all places, town by town."""
    kept = {name: value for name, value in settings.model_dump().items()
            if name in ("targets", "ahead_m", "beside_m", "noise_m", "places")}  # fmt: skip
    text = json.dumps({"generator": GENERATOR, **kept}, sort_keys=True)
    stem = hashlib.sha256(text.encode()).hexdigest()[:12]
    towns = range(settings.first_town, settings.first_town + settings.towns)
    return [f"scans-{stem}-{town:06d}-{place}.npz" for town in towns for place in range(settings.places)]


def generate_places(settings: ScanSettings, folder: Path, backend: str | None = None) -> Iterator[Path]:
    """Generates the missing places, town by town, and yields every file when it is there."""
    names = place_names(settings)
    for k in range(settings.towns):
        mine = [folder / name for name in names[k * settings.places : (k + 1) * settings.places]]
        missing = [place for place, path in enumerate(mine) if not path.is_file()]
        if missing:
            _generate_town(settings, settings.first_town + k, {place: mine[place] for place in missing}, backend)
        yield from mine


def _generate_town(settings: ScanSettings, town: int, paths: dict[int, Path], backend: str | None) -> None:
    plan = town_plan(town, "train", seconds=TOWN_S)
    ego = plan.ego_trajectory()
    with TrueWorld(plan, backend, {LOSSY: LidarResponse()}, Quality(lidar="rasterised")) as world:
        for place, path in paths.items():
            rng = np.random.default_rng([plan.seed, place, 0x11DA])
            device = str(rng.choice(list(SCANNERS), p=list(SCANNERS.values())))
            mount = geometry.pose(np.eye(3), np.array([rng.uniform(0.5, 2.0), 0.0, rng.uniform(*HEIGHT_M)]))
            free_us = plan.span_us[1] - plan.span_us[0] - 2 * MARGIN_US - SPIN_US
            start_us = plan.span_us[0] + MARGIN_US + int(free_us * (place + rng.random()) / settings.places)
            own = ego.at(np.array([start_us, start_us + SPIN_US])) @ mount
            lossy, noise_m = bool(rng.random() < DROPS), rng.uniform(0, settings.noise_m)
            poses = np.stack([own, *(own @ _shift(settings, rng) for _ in range(settings.targets))])
            lidar = scanner(device, mount)
            asked = [SensorRequest("", lidar, start_us, start_us + SPIN_US, pose) for pose in poses]
            scans = [world.scan(request) for request in asked]
            lost = np.zeros((len(scans), *scans[0].range_m.shape), bool)
            if lossy:
                dim = dataclasses.replace(lidar, id=LOSSY)
                measured = [world.scan(dataclasses.replace(request, sensor=dim)).range_m for request in asked]
                lost = np.stack([(true.range_m > 0) & (seen == 0) for true, seen in zip(scans, measured, strict=True)])
            noise = noise_m * rng.standard_normal(scans[0].range_m.shape)
            _write(path, device, mount, poses, scans, lost, noise)


def _shift(settings: ScanSettings, rng: np.random.Generator) -> np.ndarray:
    ahead, beside = settings.ahead_m, settings.beside_m
    place = [rng.uniform(-ahead, ahead), rng.uniform(-beside, beside), rng.uniform(-0.2, 0.3)]
    return geometry.pose(geometry.rotation_from_yaw(rng.uniform(-0.1, 0.1)), np.array(place))


def scanner(device: str, mount: np.ndarray) -> LidarModel:
    """A device as places have it."""
    return lidar_model(device, mount, "lidar", None if device == "AT128" else COLUMNS)


def _write(
    path: Path, device: str, mount: np.ndarray, poses: np.ndarray, scans: list[TrueScan], lost: np.ndarray,
    noise_m: np.ndarray,
) -> None:  # fmt: skip
    data = io.BytesIO()
    np.savez_compressed(
        data, device=np.array(device), mount=mount, poses=poses,
        range_m=np.stack([scan.range_m for scan in scans]).astype(np.float32),
        intensity=np.stack([scan.intensity for scan in scans]).astype(np.float16),
        label=np.stack([LABEL_OF_CLASS[scan.surface] for scan in scans]).astype(np.uint8),
        lost=np.packbits(lost, axis=-1), noise_m=noise_m.astype(np.float16),
    )  # fmt: skip
    write_file(path, data.getvalue())


def read_place(path: Path) -> Scans:
    """A place from its file.

    Raises:
        TrainingError: the file is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            lidar, ranges = scanner(str(data["device"]), data["mount"]), data["range_m"]
            lost = np.unpackbits(data["lost"], axis=-1, count=ranges.shape[2]).astype(bool)
            return Scans(lidar, data["poses"], ranges, data["intensity"].astype(np.float32), data["label"], lost,
                         data["noise_m"].astype(np.float32))  # fmt: skip
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise TrainingError(f"{path} is damaged: {error}; delete it, and it is generated again") from None
