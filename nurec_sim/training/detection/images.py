"""Images of training towns with the boxes before the camera; one file per town (``.npz``).

Cameras have the focal length at which the detector looks, and random heights, pitches and yaws beside the recorded
path. Everything about an image follows from its town, its number and the settings.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt8

from nurec_sim import geometry
from nurec_sim.errors import TrainingError
from nurec_sim.files.new_files import write_file
from nurec_sim.network.detector.objects import FOCAL_PX, Labelled, labelled_objects
from nurec_sim.training.detection.config import SceneSettings
from nurec_sim.types import CameraModel, Matrix4, Pinhole, SensorRequest
from nurec_sim.world import TrueWorld, town_plan
from nurec_sim.world.plan.rig import CAMERA_FROM_RIG_AXES
from nurec_sim.world.sense.stage import Quality

GENERATOR = 1
"""Version, to be raised when the same settings would give other images."""
SIZE_PX = 352, 224
MARGIN_US = 300_000
AHEAD_M, HEIGHT_M, PITCH_DEG, ROLL_DEG = (1.2, 2.0), (1.2, 2.1), 1.2, 0.4
"""Ranges of the mounting place, standard deviations of its angles."""
QUALITY = Quality(2, 1024)
COLUMNS = ("kind", "centre_m", "size_m", "heading_rad", "outline_px", "shown_px", "inside")


@dataclass(frozen=True, eq=False)
class TownImages:
    """Images of one town.

    Attributes:
        images: colours.
        count: objects of each image.
        objects: of all images, one after the other.
    """

    images: UInt8[np.ndarray, "n h w 3"]
    count: Int64[np.ndarray, " n"]
    objects: Labelled

    def of_image(self, index: int) -> Labelled:
        """The objects of an image."""
        first = int(self.count[:index].sum())
        rows = slice(first, first + int(self.count[index]))
        return Labelled(**{name: getattr(self.objects, name)[rows] for name in COLUMNS}, focal_px=FOCAL_PX)


def image_camera(rig_from_camera: Matrix4) -> CameraModel:
    """The camera of an image."""
    width, height = SIZE_PX
    return CameraModel("eye", width, height, Pinhole(FOCAL_PX, FOCAL_PX, width / 2, height / 2), rig_from_camera)


def image_files(settings: SceneSettings) -> list[str]:
    """Names of the files of all towns."""
    kept = {name: value for name, value in settings.model_dump().items() if name not in ("first_town", "towns")}
    text = json.dumps({"generator": GENERATOR, **kept}, sort_keys=True)
    stem = hashlib.sha256(text.encode()).hexdigest()[:12]
    return [f"objects-{stem}-{settings.first_town + town:06d}.npz" for town in range(settings.towns)]


def generate_images(settings: SceneSettings, folder: Path, backend: str | None = None) -> Iterator[Path]:
    """Generates the missing towns and yields every file when it is there."""
    for k, name in enumerate(image_files(settings)):
        if not (folder / name).is_file():
            _write(folder / name, town_images(settings, settings.first_town + k, backend))
        yield folder / name


def town_images(settings: SceneSettings, town: int, backend: str | None = None) -> TownImages:
    """The images of one town."""
    plan = town_plan(town, "train", seconds=settings.town_s)
    tracks, ego = plan.tracks(), plan.ego_trajectory()
    images, found = [], []
    with TrueWorld(plan, backend, quality=QUALITY) as world:
        for index in range(settings.images):
            rng = np.random.default_rng([plan.seed, index, 0xDE7])
            t_us = int(rng.integers(ego.start_us + MARGIN_US, ego.end_us - MARGIN_US))
            beside = settings.beside_m * float(np.clip(rng.normal(), -2, 2))
            camera = image_camera(_mount(rng, settings))
            pose = ego.at(t_us) @ geometry.pose(np.eye(3), np.array([0.0, beside, 0.0])) @ camera.rig_from_camera
            view = world.view(SensorRequest("", camera, t_us, t_us + 1, np.stack([pose, pose])))
            images.append(view.rgb)
            found.append(labelled_objects(tracks, t_us, camera, pose, view.instance))
    columns = {name: np.concatenate([getattr(each, name) for each in found]) for name in COLUMNS}
    objects = Labelled(**columns, focal_px=FOCAL_PX)
    return TownImages(np.array(images), np.array([len(each) for each in found]), objects)


def _mount(rng: np.random.Generator, settings: SceneSettings) -> Matrix4:
    """A random camera pose in the rig."""
    place = np.array([rng.uniform(*AHEAD_M), 0.0, rng.uniform(*HEIGHT_M)])
    yaw = np.deg2rad(settings.turned_deg) * float(np.clip(rng.normal(), -2, 2))
    pitch, roll = np.deg2rad(PITCH_DEG) * rng.normal(), np.deg2rad(ROLL_DEG) * rng.normal()
    about_y = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    return geometry.pose(geometry.rotation_from_yaw(yaw) @ about_y @ about_x @ CAMERA_FROM_RIG_AXES, place)


def _write(path: Path, town: TownImages) -> None:
    data = io.BytesIO()
    objects: dict[str, Any] = {name: getattr(town.objects, name) for name in COLUMNS}
    np.savez_compressed(data, images=town.images, count=town.count, **objects)
    write_file(path, data.getvalue())


def read_images(path: Path) -> TownImages:
    """The images of a town from their file.

    Raises:
        TrainingError: the file is damaged.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            objects = Labelled(**{name: data[name] for name in COLUMNS}, focal_px=FOCAL_PX)
            return TownImages(data["images"], data["count"], objects)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise TrainingError(f"{path} is damaged: {error}; delete it, and it is generated again") from None
