"""Comparing a camera's frames with one another: locally normalised brightness, and projection by rays alone.

Shared by ``plane_sweep``, ``motion_search`` and ``depth_refinement``. Nothing is learned; any lens works.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from nurec_sim.network.tensors import NetworkInputs

SHRINK = 2
CONTRAST_WINDOW_PX = 7
"""Windows in which brightness is normalized."""
LEAST_CONTRAST = 0.02
"""Below this deviation within a window, brightness in 0..1 is noise."""
LENS_STEPS, STRAIGHT_PX = 2, 0.05
"""Corrections of projections into an image, and how far pixels of a lens that needs none are from a pinhole's."""


@dataclass(frozen=True)
class SmallImages:
    """The images of a clip, mostly ``SHRINK`` times smaller.

    Attributes:
        rgb: colours.
        grey: brightness.
        local: the same normalized.
        rays: origins in metres and unit directions, scene frame.
        along: z of the unit ray in its camera.
        views: projection into each image.
    """

    rgb: Float[Tensor, "v 3 h w"]
    grey: Float[Tensor, "v 1 h w"]
    local: Float[Tensor, "v 1 h w"]
    rays: Float[Tensor, "v h w 6"]
    along: Float[Tensor, "v h w"]
    views: list[ImageView]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.grey.shape[2], self.grey.shape[3]


def small_images(inputs: NetworkInputs, clip: int, shrink: int = SHRINK) -> SmallImages:
    """The images of one clip of the batch, reduced.

    Args:
        inputs: the batch.
        clip: index of the clip.
        shrink: factor of the reduction.
    """
    rgb, rays = inputs.rgb[clip].float(), inputs.rays[clip].float()
    size = (max(1, rgb.shape[1] // shrink), max(1, rgb.shape[2] // shrink))

    def smoothed(values: Float[Tensor, "v h w c"]) -> Float[Tensor, "v hh ww c"]:
        small = functional.interpolate(values.permute(0, 3, 1, 2), size, mode="bilinear", antialias=True)
        return small.permute(0, 2, 3, 1)

    colours = functional.interpolate(rgb.permute(0, 3, 1, 2), size, mode="area")
    grey = colours.mean(1, keepdim=True)
    small = smoothed(rays)
    # Means of unit vectors are shorter than 1.
    small = torch.cat([small[..., :3], functional.normalize(small[..., 3:], dim=-1)], dim=-1)
    along = smoothed(inputs.distance_to_depth_scale[clip].float())[..., 0]
    views = [ImageView(each, pose.float()) for each, pose in zip(small, inputs.c2w[clip], strict=True)]
    return SmallImages(colours, grey, locally_normalized(grey), small, along, views)


def neighbours(camera: Tensor, time: Tensor, image: int, steps: tuple[int, ...]) -> list[int]:
    """Images of the same camera at given offsets from one in the order of time.

    Args:
        camera: [v] camera index of every image.
        time: [v] when each was exposed, in any unit.
        image: index of the image.
        steps: offsets in places, negative for earlier; those beyond the first or last frame are left out.
    """
    same = torch.nonzero(camera == camera[image]).flatten().tolist()
    order = sorted(same, key=lambda k: (float(time[k]), k))
    place = order.index(image)
    return [order[place + step] for step in steps if 0 <= place + step < len(order)]


class ImageView:
    """Projection into an image by its rays alone, whatever its lens: a pinhole first, then corrected by the rays."""

    def __init__(self, rays: Float[Tensor, "h w 6"], c2w: Float[Tensor, "4 4"]) -> None:
        height, width = rays.shape[:2]
        self.eye, self.turn = rays[height // 2, width // 2, :3], c2w[:3, :3]
        ahead = rays[..., 3:] @ self.turn
        plane = ahead[..., :2] / ahead[..., 2:].clamp(min=0.05)
        self.plane = plane.permute(2, 0, 1)[None]
        # Places in an image are -1..1 from edge to edge, as grid_sample wants them.
        y, x = torch.meshgrid(
            (torch.arange(height, device=rays.device) * 2 + 1) / height - 1,
            (torch.arange(width, device=rays.device) * 2 + 1) / width - 1,
            indexing="ij",
        )
        self.lines = [_line(plane[..., k], place) for k, place in enumerate((x, y))]
        # A pinhole without distortion is linear in x / z and needs no correction steps.
        wrong = [line.wrong * size / 2 for line, size in zip(self.lines, (width, height), strict=True)]
        self.steps = LENS_STEPS if max(wrong) > STRAIGHT_PX else 0

    def places(self, rays: Float[Tensor, "h w 6"], distance: Float[Tensor, "d h w"]) -> Places:
        """Where points along rays are seen in this image."""
        # Axis by axis: products with matrices of 3 x 3 take several times as long.
        origin, direction = (rays[..., :3] - self.eye) @ self.turn, rays[..., 3:] @ self.turn
        return self._placed(*(origin[..., k] + distance * direction[..., k] for k in range(3)))

    def places_of_moved(self, points: Float[Tensor, "n 3"], shifts: Float[Tensor, "d 3"]) -> Places:
        """Where points are seen after each of these shifts; h is 1."""
        here, moved = (points - self.eye) @ self.turn, shifts @ self.turn
        return self._placed(*(here[None, None, :, k] + moved[:, None, None, k] for k in range(3)))

    def _placed(self, x: Float[Tensor, "d h w"], y: Float[Tensor, "d h w"], z: Float[Tensor, "d h w"]) -> Places:
        nearness = 1 / z.clamp(min=0.1)
        wanted = [x * nearness, y * nearness]
        place = [each * line.slope + line.start for each, line in zip(wanted, self.lines, strict=True)]
        # Newton steps on "the plane coordinate of the pixel at this place equals the wanted one", with the global slope
        # as derivative: the lens is only known by the rays of its pixels.
        for _ in range(self.steps):
            reached = sampled(self.plane, torch.stack(place, dim=-1))
            place = [
                at + (goal - now) * line.slope
                for at, goal, now, line in zip(place, wanted, reached, self.lines, strict=True)
            ]
        inside = (z > 0.3) & (place[0].abs() < 1) & (place[1].abs() < 1)
        return Places(torch.stack(place, dim=-1), z, inside)


class Places(NamedTuple):
    """Places -1..1 of points in an image, their z-depths in metres, and whether they are seen."""

    place: Float[Tensor, "d h w 2"]
    depth_m: Float[Tensor, "d h w"]
    inside: Bool[Tensor, "d h w"]


class _Line(NamedTuple):
    slope: float
    start: float
    wrong: float


def _line(plane: Tensor, place: Tensor) -> _Line:
    """The places over coordinates in the image plane at z = 1, by least squares, and the largest error."""
    away = plane - plane.mean()
    slope = float((away * place).sum() / (away**2).sum().clamp(min=1e-9))
    start = float(place.mean() - slope * plane.mean())
    return _Line(slope, start, float((slope * plane + start - place).abs().max()))


def sampled(values: Float[Tensor, "1 c h w"], place: Float[Tensor, "d h w 2"]) -> Float[Tensor, "c d h w"]:
    """Values of an image at places in it, bilinear; beyond its edge those of the edge."""
    d, h, w = place.shape[:3]
    flat = place.reshape(1, d * h, w, 2)
    sampled = functional.grid_sample(values, flat, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled[0].reshape(-1, d, h, w)


def locally_normalized(grey: Float[Tensor, "v 1 h w"]) -> Float[Tensor, "v 1 h w"]:
    """Brightness minus the mean of its window, over its deviation; nearly 0 where there is no texture."""
    mean = window_mean(grey, CONTRAST_WINDOW_PX)
    # Var = E[x^2] - E[x]^2; rounding can make it slightly negative where there is no texture.
    deviation = (window_mean(grey**2, CONTRAST_WINDOW_PX) - mean**2).clamp(min=0).sqrt()
    return (grey - mean) / (deviation + LEAST_CONTRAST)


def window_mean(values: Float[Tensor, "n c h w"], width_px: int) -> Float[Tensor, "n c h w"]:
    """Means over square windows, which are cut off at the edges of the image."""
    for window, edge in (((width_px, 1), (width_px // 2, 0)), ((1, width_px), (0, width_px // 2))):
        values = functional.avg_pool2d(values, window, 1, edge, count_include_pad=False)
    return values
