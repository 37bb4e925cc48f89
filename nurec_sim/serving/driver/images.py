"""Camera images for policies: checked before they are decoded, rectified to ideal pinholes.

Policies only ever meet ideal pinhole images of the width that they need (``sim.policy_sensors``). In our own loop
such an image is rendered; a client of the egodriver interface sends what its camera sees, fisheye and all.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, UInt8

from nurec_sim import sensors
from nurec_sim.errors import RequestError, TooLargeError
from nurec_sim.files import decoding
from nurec_sim.serving.wire.driving import EncodedImage
from nurec_sim.sim.policy_sensors import policy_camera
from nurec_sim.types import CameraFrame, CameraModel

MAX_IMAGE_PIXELS = 4096 * 4096
MAX_SEEN_PIXELS = 2048 * 2048
"""Limit for the image that a policy sees: at a given width, a very tall image can still have too many pixels."""


def image_size(data: bytes, name: str) -> tuple[int, int]:
    """Width and height of a PNG or JPEG file by its header; nothing is decoded.

    Raises:
        RequestError: it is neither, or ends early.
        TooLargeError: it has more than ``MAX_IMAGE_PIXELS``.
    """
    try:
        return decoding.check_image(data, MAX_IMAGE_PIXELS)
    except decoding.TooMuchError as error:
        raise TooLargeError(f"{name} {error}") from None
    except ValueError as error:
        raise RequestError(f"{name} {error}") from None


def decode_image(data: bytes, name: str) -> UInt8[np.ndarray, "h w 3"]:
    """The pixels of a file that ``image_size`` accepts, as RGB.

    Raises:
        RequestError: it is damaged.
    """
    import cv2

    width, height = image_size(data, name)
    try:
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        bgr = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        bgr = None
    if bgr is None or bgr.shape != (height, width, 3):
        raise RequestError(f"{name} cannot be decoded: its {len(data)} bytes are damaged")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def see_image(image: EncodedImage, camera: CameraModel, width_px: int) -> CameraFrame:
    """A client's image as the frame that a policy expects.

    Args:
        image: what the client sent.
        camera: its camera as the client described it, at any resolution.
        width_px: the width that the policy needs; an image that is marked ``as_is`` keeps its own.

    Raises:
        RequestError: the image is damaged, or marked ``as_is`` and not that of an ideal pinhole, or the camera is one
            that shows nothing.
        TooLargeError: the policy would see more than ``MAX_SEEN_PIXELS``.
    """
    import cv2

    rgb = decode_image(image.data, f"the image of camera {image.camera_id!r} at {image.end_us}")
    try:
        taken = sensors.scaled_camera(camera, rgb.shape[1], rgb.shape[0])
        sensors.check_camera(taken)
        if not image.as_is:
            wanted = policy_camera(taken, width_px)
            sensors.check_camera(wanted)
            if wanted.width_px * wanted.height_px > MAX_SEEN_PIXELS:
                raise TooLargeError(
                    f"camera {camera.id!r}: a policy may see {MAX_SEEN_PIXELS} pixels, "
                    f"not {wanted.width_px} x {wanted.height_px}"
                )
            rgb, taken = _rectified(rgb, taken, wanted), wanted
    except (ValueError, ArithmeticError, cv2.error) as error:
        raise RequestError(f"camera {camera.id!r} cannot be rectified: {error}") from error
    if taken.ideal_pinhole is None:
        raise RequestError(f"an image as_is must be an ideal pinhole's; camera {camera.id!r} has another lens")
    return CameraFrame(taken, image.start_us, image.end_us, rgb)


def _rectified(rgb: UInt8[np.ndarray, "h w 3"], taken: CameraModel, wanted: CameraModel) -> UInt8[np.ndarray, "h w 3"]:
    """What an ideal pinhole of the same pose would have seen; black where the lens saw nothing."""
    import cv2

    shrink = taken.width_px // wanted.width_px
    if shrink > 1:  # first the mean over what falls into one pixel: sampling single ones would flicker
        taken = sensors.scaled_camera(taken, taken.width_px // shrink, max(1, taken.height_px // shrink))
        rgb = cv2.resize(rgb, (taken.width_px, taken.height_px), interpolation=cv2.INTER_AREA)
    if taken.lens == wanted.lens and rgb.shape[:2] == (wanted.height_px, wanted.width_px):
        return rgb
    columns, rows = _sampled_pixels(taken, wanted)
    return cv2.remap(rgb, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def _sampled_pixels(
    taken: CameraModel, wanted: CameraModel
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Where in the taken image each wanted pixel lies, counted by pixel centres as OpenCV does."""
    rays, _ = sensors.pixel_rays(wanted)
    pixels, valid = sensors.project(taken, rays.reshape(-1, 3))
    pixels = np.where(valid[:, None], pixels - 0.5, -1e4).astype(np.float32)
    shape = (wanted.height_px, wanted.width_px)
    return pixels[:, 0].reshape(shape), pixels[:, 1].reshape(shape)
