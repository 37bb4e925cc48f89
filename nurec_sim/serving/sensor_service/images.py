"""Image replies: encoding, and ego masks (images of the recording car's own body) overlaid."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from nurec_sim.compute.turns import aside, rest
from nurec_sim.errors import RequestError
from nurec_sim.files.decoding import image_pixels
from nurec_sim.render.cpu.workers import Workers
from nurec_sim.render.ego import Overlay
from nurec_sim.serving import wire
from nurec_sim.serving.sensor_service.render_queue import LARGE_RAYS
from nurec_sim.serving.wire import sensorsim
from nurec_sim.types import CameraFrame


class EgoMasks:
    """The masks of one folder, ``<folder>/<rig>/<camera>.png``.

    A picture with four channels is blended by its alpha; in one without, every pixel that is not black covers.

    Args:
        folder: where the masks lie, None for no masks.

    Raises:
        FileNotFoundError: the folder does not exist.
    """

    def __init__(self, folder: Path | None = None) -> None:
        if folder is not None and not folder.is_dir():
            raise FileNotFoundError(f"the ego mask folder {folder} does not exist")
        files = sorted(folder.glob("*/*.png")) if folder else []
        self._paths = {(path.parent.name, path.stem): path for path in files}

    @property
    def ids(self) -> tuple[tuple[str, str], ...]:
        """(rig, camera) of every mask."""
        return tuple(self._paths)

    def has(self, camera: str) -> bool:
        """Whether there is a mask of a camera, of any rig."""
        return any(camera == name for _, name in self._paths)

    def find(self, key: tuple[str, str]) -> tuple[str, str]:
        """The (rig, camera) of the mask that is meant: ``key``, or with an empty rig the only one that has the camera.

        Raises:
            RequestError: there is none, or more than one; the text lists the masks.
        """
        rigs = [rig for rig, camera in self._paths if camera == key[1]]
        if not key[0] and len(rigs) == 1:
            return rigs[0], key[1]
        if key not in self._paths:
            raise RequestError(f"there is no ego mask for (rig, camera) {key}; have {list(self._paths)}")
        return key

    def overlay(self, rgb: UInt8[np.ndarray, "h w 3"], key: tuple[str, str]) -> UInt8[np.ndarray, "h w 3"]:
        """A copy of an image with the mask, scaled to its size, overlaid."""
        return _scaled_mask(self._paths[self.find(key)], rgb.shape[1], rgb.shape[0]).over(rgb)


@lru_cache(maxsize=32)
def _scaled_mask(path: Path, width_px: int, height_px: int) -> Overlay:
    import cv2

    try:
        bgra = image_pixels(path.read_bytes(), cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError) as error:
        raise RequestError(f"the ego mask {path.parent.name}/{path.name} is not a readable PNG") from error
    scale = 65535 if bgra.dtype == np.uint16 else 255
    bgra = np.atleast_3d(bgra.astype(np.float32) * (255 / scale))
    rgb = np.repeat(bgra[..., :1], 3, axis=2) if bgra.shape[2] < 3 else bgra[..., 2::-1]
    cover = bgra[..., 3:4] / 255 if bgra.shape[2] == 4 else (rgb.max(axis=2, keepdims=True) > 0).astype(np.float32)
    # Premultiplied alpha while scaling, so that colours of transparent pixels do not bleed in.
    layers = np.concatenate([rgb * cover, cover], axis=2)
    return Overlay.of(cv2.resize(layers, (width_px, height_px), interpolation=cv2.INTER_AREA))


class ImageReplies:
    """Encodes images in threads of its own.

    Args:
        masks: what may be laid over images.
        threads: images encoded at the same time.
    """

    def __init__(self, masks: EgoMasks, threads: int) -> None:
        self._masks = masks
        self._encoders = Workers(threads)

    def of(self, frames: Sequence[Any], options: Sequence[wire.ImageOptions]) -> list[Any]:
        """An ``RGBRenderReturn``, or an error, for each frame: its colours in the requested format."""
        calls = [(self._reply, *pair) for pair in zip(frames, options, strict=True)]
        if all(frame.rgb.size <= 3 * LARGE_RAYS for frame in frames):
            return self._encoders.run_calls(calls)
        results = []
        for first in range(0, len(calls), self._encoders.threads):
            rest()
            with aside():  # an encoder cannot be interrupted
                results += self._encoders.run_calls(calls[first : first + self._encoders.threads])
        return results

    def _reply(self, frame: CameraFrame, options: wire.ImageOptions):
        try:
            rgb = self._masks.overlay(frame.rgb, options.ego_mask) if options.ego_mask else frame.rgb
            reply = sensorsim.RGBRenderReturn()
            wire.write_image(rgb, options, reply)
            return reply
        except Exception as error:
            return error
