"""Images resized and cropped to the network's size, and the cameras that see exactly the result.

The rule of the release: the larger of the two scales that reach the wanted size, the other side rounded, bilinear with
anti-aliasing, centre crop; pixel p (corner-origin) becomes ``p * resized / original - offset``. For profiles of the
release the resampling also has ``align_corners=True``. Together with anti-aliasing this samples
``p * (resized - 1) / (original - 1)``, so their images are up to 0.6 pixels off their intrinsics at the right and the
lower edge; the released weights were trained so. Our own profiles resample without it, where image and camera agree.
Those that keep the cameras' aspect rather stretch the image a little than cut something away.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from nurec_sim import geometry, sensors
from nurec_sim.errors import ReconstructError
from nurec_sim.network.profiles import PATCH_PX, Profile
from nurec_sim.types import CameraModel, Shutter

SMALLEST_PX = 2 * PATCH_PX
MOST_STRETCH = 1.1
"""Of the aspect of images that are not cropped."""


@dataclass(frozen=True)
class Crop:
    """A resize followed by a crop; all pairs are (width, height) in pixels.

    Attributes:
        resized: size before cropping.
        offset: left and upper pixels cut off.
        size: size of the result.
        align_corners: whether the resampling is the release's (see above).
    """

    resized: tuple[int, int]
    offset: tuple[int, int]
    size: tuple[int, int]
    align_corners: bool


def input_size(profile: Profile, camera: CameraModel, pixels: int | None = None) -> tuple[int, int]:
    """Width and height of a chunk's images; ``camera`` is its first one, whose aspect some profiles keep.

    Raises:
        ReconstructError: ``pixels`` asks for another size of images than the profile's only one.
    """
    if not profile.keeps_aspect:
        if pixels is not None:
            raise ReconstructError(
                f"images of profile {profile.name!r} always have {profile.width_px} x {profile.height_px} px; "
                f"image_pixels must not be given, got {pixels}"
            )
        return profile.width_px, profile.height_px
    patches = (pixels or profile.width_px * profile.height_px) / PATCH_PX**2
    across = np.sqrt(patches * camera.width_px / camera.height_px)
    width, height = (max(SMALLEST_PX, PATCH_PX * round(float(n))) for n in (across, patches / across))
    return width, height


def plan_crop(profile: Profile, camera: CameraModel, size: tuple[int, int]) -> Crop:
    """How images of a camera come to ``size``."""
    stretch = size[0] / size[1] / (camera.width_px / camera.height_px)
    if profile.keeps_aspect and 1 / MOST_STRETCH < stretch < MOST_STRETCH:
        return Crop(size, (0, 0), size, align_corners=False)
    scale = max(size[0] / camera.width_px, size[1] / camera.height_px)
    width = max(size[0], round(camera.width_px * scale))
    height = max(size[1], round(camera.height_px * scale))
    offset = ((width - size[0]) // 2, (height - size[1]) // 2)
    return Crop((width, height), offset, size, align_corners=not profile.keeps_aspect)


def crop_image(image: UInt8[np.ndarray, "h0 w0 3"], crop: Crop) -> Float[Tensor, "h w 3"]:
    """The image resized and cropped, colours in 0..1."""
    pixels = torch.tensor(image).permute(2, 0, 1)[None].contiguous().float()
    resized = torch.nn.functional.interpolate(
        pixels, size=crop.resized[::-1], mode="bilinear", align_corners=crop.align_corners, antialias=True
    )
    (x, y), (width, height) = crop.offset, crop.size
    cropped = resized[0, :, y : y + height, x : x + width].permute(1, 2, 0) / 255
    return cropped.clamp(0, 1).contiguous()


def crop_camera(camera: CameraModel, crop: Crop) -> CameraModel:
    """The camera of the cropped image, for every lens; windshield, shutter and mounting stay."""
    scaled = sensors.scaled_camera(camera, *crop.resized)
    lens = scaled.lens.cropped(*crop.offset)
    return dataclasses.replace(scaled, width_px=crop.size[0], height_px=crop.size[1], lens=lens)


def crop_exposure(
    camera: CameraModel, crop: Crop, t_us: tuple[int, int], world_from_camera: Float64[np.ndarray, "2 4 4"]
) -> tuple[tuple[int, int], Float64[np.ndarray, "2 4 4"]]:
    """Times and poses at which the first and the last line of the cropped image were exposed.

    A crop across a rolling shutter sees only a part of the exposure. With these two ends, ``sensors.shutter_fraction``
    of the cropped camera gives every line the pose that it had in the whole image; resizing alone changes nothing.

    Args:
        camera: the camera before the crop.
        crop: the resize and crop.
        t_us: start and end of the whole image's exposure, microseconds.
        world_from_camera: poses at those two instants.

    Returns:
        Times and poses in the same form, of the crop.
    """
    if camera.shutter is Shutter.GLOBAL:
        return t_us, world_from_camera
    whole = sensors.scaled_camera(camera, *crop.resized)
    (x, y), (width, height) = crop.offset, crop.size
    corners = np.array([[x + 0.5, y + 0.5], [x + width - 0.5, y + height - 0.5]])
    fractions = np.sort(sensors.shutter_fraction(whole, corners))
    if np.array_equal(fractions, (0, 1)):
        return t_us, world_from_camera
    first, last = (t_us[0] + round(float(fraction) * (t_us[1] - t_us[0])) for fraction in fractions)
    return (first, last), geometry.interpolate_pose_pair(world_from_camera, fractions)
