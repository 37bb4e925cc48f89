"""Sizes of the network: the three released profiles, the full training model, and our own small ones.

A profile is data: it holds every number that the architecture depends on; the modules hold none of their own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

PATCH_PX = 14
"""Edge of the square patches that become tokens; widths and heights are multiples of it."""


@dataclass(frozen=True)
class EncoderSize:
    """The alternating-attention vision transformer (paper section 3.2).

    Blocks before ``alternate_from`` attend within each image; from there on even blocks attend within images, odd ones
    across all images. The features after ``taps`` (all odd) go to the heads, twice as wide as ``width``: last local and
    global state. ``car_view`` adds a per-patch embedding of the ray as seen from the car, which the released network
    lacks.
    """

    width: int = 768
    depth: int = 12
    heads: int = 12
    alternate_from: int = 4
    taps: tuple[int, int, int, int] = (5, 7, 9, 11)
    position_grid: int = 37
    camera_depth: int = 4
    camera_heads: int = 16
    car_view: bool = False


@dataclass(frozen=True)
class HeadSize:
    """A DPT head: channels of the four levels from fine to coarse, of their fusion, and of the last two layers.

    ``pixel_detail`` feeds the image and the ``car_view`` to the last layers of the depth and the context head; the
    released network feeds the image to those of the context head only. Where patches are coarse, only the image holds
    the edges of objects.
    """

    levels: tuple[int, int, int, int] = (96, 192, 384, 768)
    fused: int = 128
    last: int = 32
    pixel_detail: bool = False


@dataclass(frozen=True)
class SelectiveSize:
    """The point-query decoder: tokens of ``cell`` x ``cell`` pixels, strided ones everywhere, full ones on the road."""

    depth: int = 3
    heads: int = 12
    stride: int = 2
    cell: int = 8
    road_slots: int = 512


@dataclass(frozen=True)
class MotionSize:
    """The motion decoder: width of the sinusoids that code times."""

    time_channels: int = 256


@dataclass(frozen=True)
class SkySize:
    """The learned sky: cubemap edge in pixels and its small transformer.

    ``kind`` is the paper's ``decoder``, or the ``mlp`` of its ablation, which has neither ``depth`` nor ``levels``.
    """

    cubemap_px: int = 448
    width: int = 384
    depth: int = 1
    heads: int = 12
    levels: tuple[int, int, int, int] = (48, 96, 192, 384)
    kind: Literal["decoder", "mlp"] = "decoder"


@dataclass(frozen=True)
class Profile:
    """One size of the network and the inputs that it was made for.

    Attributes:
        name: how users call it.
        width_px: image width, a multiple of 14.
        height_px: image height, a multiple of 14.
        cameras: numbers of cameras that it was trained with.
        frames: fewest and most frames per camera.
        frames_alone: most frames of a camera that is the only one, None for no more than of several.
        decoder: one Gaussian per pixel (``dense``), or clusters around chosen points (``selective``).
        keeps_aspect: whether the input size follows the cameras' aspect ratio at about the same number of pixels;
            otherwise images are cropped to ``width_px`` x ``height_px``, as the release does.
        encoder: size of the encoder.
        head: size of each DPT head.
        selective: size of the point-query decoder.
        motion: size of the motion decoder.
        sky: size of the learned sky; None uses the sky seen in the images.
        observed_sky_px: edge of the cubemap of the observed sky.
        log_geometry: whether matching refines the depth and finds the motion of movable objects, and Gaussians start as
            the footprints of their pixels; the released network has learned all that.
        image_colours: whether canonical colours are those of the images (``network.image_colours``) or decoded ones.
        isp_heads: attention heads of the decoder of camera responses.
        training_buffers: whether the state dict holds the constants that files of the training code hold.
        checkpoint: id of the released file, None if there is none.
    """

    name: str
    width_px: int = 784
    height_px: int = 448
    cameras: tuple[int, ...] = (1,)
    frames: tuple[int, int] = (1, 18)
    frames_alone: int | None = None
    decoder: Literal["dense", "selective"] = "dense"
    keeps_aspect: bool = False
    encoder: EncoderSize = EncoderSize()
    head: HeadSize = HeadSize()
    selective: SelectiveSize = SelectiveSize()
    motion: MotionSize = MotionSize()
    sky: SkySize | None = None
    observed_sky_px: int = 448
    log_geometry: bool = False
    image_colours: bool = False
    isp_heads: int = 16
    training_buffers: bool = False
    checkpoint: str | None = None


_TINY = Profile(
    name="tiny",
    width_px=392,
    height_px=238,
    cameras=(1, 3, 5),
    frames=(1, 18),
    frames_alone=36,
    keeps_aspect=True,
    encoder=EncoderSize(144, 10, 3, 2, (3, 5, 7, 9), 16, 1, 4, car_view=True),
    head=HeadSize((24, 48, 72, 72), 48, 16, pixel_detail=True),
    selective=SelectiveSize(depth=1, heads=6, road_slots=60),
    motion=MotionSize(64),
    sky=SkySize(112, 48, 1, 3, (24, 48, 48, 48)),
    observed_sky_px=112,
    log_geometry=True,
    image_colours=True,
    isp_heads=6,
)
_TINY_SKY_MLP = SkySize(112, 96, heads=3, kind="mlp")

PROFILES: Mapping[str, Profile] = {
    profile.name: profile
    for profile in (
        Profile("pa-front", checkpoint="instant_nurec_pa_front_1.1.0"),
        Profile("pa-multiview", 504, 280, (1, 3, 5), checkpoint="instant_nurec_pa_multiview_1.1.0"),
        Profile("pq-front", decoder="selective", checkpoint="instant_nurec_pq_road_1.0.0"),
        Profile("pa-full", sky=SkySize(), training_buffers=True),
        _TINY,
        dataclasses.replace(_TINY, name="tiny-selective", height_px=294, decoder="selective"),
        dataclasses.replace(_TINY, name="tiny-sky-mlp", sky=_TINY_SKY_MLP),
    )
}
"""By name. ``pa-full`` is the training model with the learned sky; no weights of it are published. ``tiny-sky-mlp`` is
for the ablation of the sky (docs/training.md)."""
