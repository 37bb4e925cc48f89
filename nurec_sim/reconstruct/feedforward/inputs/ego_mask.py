"""Masks of the recording car's own body, one PNG per camera, brought to the network's images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from nurec_sim.errors import ReconstructError
from nurec_sim.files.decoding import image_pixels
from nurec_sim.reconstruct.feedforward.inputs.crop import Crop
from nurec_sim.types import Clip

FAINTEST_COVER = 1e-3


def ego_masks(
    folder: Path | None,
    images: Mapping[str, UInt8[np.ndarray, "h w 4"]],
    clip: Clip,
    crops: Mapping[str, Crop],
) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Where the car covers the view of each camera in ``crops``; nowhere for cameras without a mask.

    Without a folder, what is not transparent in ``images`` is covered. A mask ``<folder>/<camera>.png`` may have any
    size and is stretched over the whole image. One with an alpha channel covers where alpha is not 0, one without where
    it is not black; a pixel is covered as soon as a part of it is.

    Raises:
        ReconstructError: the folder does not exist or has no mask for any camera of the clip, or a file is broken.
    """
    own = {name: rgba[..., 3] > 0 for name, rgba in images.items()}
    if folder is not None:
        own = _masks_in(folder, clip, crops)
    return {
        camera: np.zeros(crop.size[::-1], bool) if (mask := own.get(camera)) is None else _scaled(mask, crop)
        for camera, crop in crops.items()
    }


def _masks_in(folder: Path, clip: Clip, cameras: Iterable[str]) -> dict[str, Bool[np.ndarray, "h w"]]:
    if not folder.is_dir():
        raise ReconstructError(f"the folder of ego masks {folder} does not exist")
    names = sorted(path.stem for path in folder.glob("*.png"))
    if not set(names) & set(clip.rig.cameras):
        raise ReconstructError(
            f"no file in {folder} is named after a camera: need <camera>.png of {list(clip.rig.cameras)}, have {names}"
        )
    return {camera: _read(folder / f"{camera}.png") for camera in cameras if camera in names}


def _read(path: Path) -> Bool[np.ndarray, "h w"]:
    try:
        channels = np.atleast_3d(image_pixels(path.read_bytes(), cv2.IMREAD_UNCHANGED))
    except (OSError, ValueError) as error:
        raise ReconstructError(f"the ego mask {path} is not a readable PNG") from error
    return (channels[..., 3] if channels.shape[2] == 4 else channels.max(axis=2)) > 0


def _scaled(mask: Bool[np.ndarray, "h w"], crop: Crop) -> Bool[np.ndarray, "h w"]:
    resized = cv2.resize(mask.astype(np.float32), crop.resized, interpolation=cv2.INTER_AREA)
    (x, y), (width, height) = crop.offset, crop.size
    return resized[y : y + height, x : x + width] > FAINTEST_COVER
