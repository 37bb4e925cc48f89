"""Motion by matching: displacement of each movable object, found again in the neighbouring frames of its camera.

Nothing is learned. Objects are connected regions of the pixels classified as movable; each moves over the ground as a
whole and at a constant velocity from the previous frame to the next. What is not found again keeps its decoded motion.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from nurec_sim.network.stereo.matching import ImageView, neighbours, sampled, small_images
from nurec_sim.network.tensors import NetworkInputs

FARTHEST_M = (12.0, 6.0)
"""How far objects may move from one frame to the next, along the car's axis and across it."""
STEP_PX, MOST_STEPS = 2.5, 40
"""Width of a step across in the smaller image; the number of steps to either side is bounded."""
STEP_ALONG_M, STEP_ALONG_SHARE = 0.6, 1 / 15
"""Steps along the car's axis: least, and as a share of the distance."""
ROUNDS, FINER = 3, 2.5
"""Number of searches around the best after the first one, and the factor by which each reduces the step."""
CONTRAST, COLOUR = 2.0, 0.1
"""Differences of normalized brightness, and of colours, at which the cost saturates."""
OUTSIDE = 0.5
"""Cost of points that the other image does not show."""
FAR_PENALTY, BETTER = 0.05, 0.06
"""Cost of the largest possible motion; and how much better than no motion a motion must fit."""
EDGE = 0.15
"""Objects end where the logarithm of the depth jumps by more."""
LEAST_PIXELS, MOST_OBJECTS = 32, 8
"""Pixels of an object, and objects in an image, the largest ones."""
SAMPLES, FIRST_SAMPLES = 128, 40
"""Number of compared points of an object, about, and in the first search."""


@torch.no_grad()
def searched_motion(
    inputs: NetworkInputs,
    depth_m: Float[Tensor, "b v h w"],
    movable: Bool[Tensor, "b v h w"],
    motion_m: Float[Tensor, "b v h w 2 3"],
) -> Float[Tensor, "b v h w 2 3"]:
    """``motion_m`` with that of movable objects replaced wherever matching found it.

    Args:
        inputs: the images and their rays; ``rig_from_scene`` must be given.
        depth_m: z-depth, metres.
        movable: pixels of objects that can move.
        motion_m: displacements to the times before and after, metres, scene frame.

    Raises:
        ValueError: the inputs lack ``rig_from_scene``.
    """
    if inputs.rig_from_scene is None:
        raise ValueError("motion_search needs inputs with rig_from_scene, the scene frame as seen from the car")
    car_axes = inputs.rig_from_scene[:, :2, :3]  # the car's x and y in the scene frame
    found = motion_m.clone()
    with torch.autocast(depth_m.device.type, enabled=False):
        for clip in range(len(depth_m)):
            if movable[clip].any():
                _search_clip(inputs, clip, depth_m[clip].float(), movable[clip], car_axes[clip], found[clip])
    return found


def _search_clip(
    inputs: NetworkInputs,
    clip: int,
    depth_m: Float[Tensor, "v h w"],
    movable: Bool[Tensor, "v h w"],
    car_axes: Float[Tensor, "2 3"],
    motion_m: Float[Tensor, "v h w 2 3"],
) -> None:
    """Writes what is found into ``motion_m``."""
    images = small_images(inputs, clip)
    appearance = torch.cat([images.local / CONTRAST, images.rgb / COLOUR], dim=1)
    time = inputs.time[clip]
    gaps = torch.stack([inputs.time_before[clip] - time, inputs.time_after[clip] - time], dim=-1)
    distance = depth_m / inputs.distance_to_depth_scale[clip, ..., 0].clamp(min=1e-3)
    points = inputs.rays[clip, ..., :3] + inputs.rays[clip, ..., 3:] * distance[..., None]
    for k in range(len(depth_m)):
        others = neighbours(inputs.camera_idxs[clip], time, k, (-1, 1))
        spans = [float(time[n] - time[k]) for n in others]
        if not others or min(abs(span) for span in spans) <= 0:
            continue
        # Both neighbours test one velocity: shifts are per shortest gap and scale with each frame's own.
        unit = min(abs(span) for span in spans)
        frames = [_Frame(images.views[n], appearance[n], span / unit) for n, span in zip(others, spans, strict=True)]
        object_of = torch.from_numpy(objects_of(depth_m[k], movable[k])).to(depth_m.device)
        for number in range(1, int(object_of.max()) + 1):
            mine = object_of == number
            moved = _Object(points[k][mine], _appearance_at(appearance[k], mine))
            shift = moved.search(frames, car_axes, images.size[1])
            motion_m[k][mine] = (gaps[k, :, None] / unit * shift)[None].to(motion_m.dtype)


def objects_of(depth_m: Float[Tensor, "h w"], movable: Bool[Tensor, "h w"]) -> Int32[np.ndarray, "h w"]:
    """Numbers of the largest connected pieces of what is movable, from 1; 0 elsewhere. Pieces end at edges of depth."""
    log_depth, mask = depth_m.clamp(min=1e-3).log().cpu().numpy(), movable.cpu().numpy()
    jump = np.zeros(mask.shape, bool)
    # Log depth, so that the threshold is a ratio: 15 % separates a near car from the one behind it.
    jump[:, 1:] |= np.abs(np.diff(log_depth, axis=1)) > EDGE
    jump[1:] |= np.abs(np.diff(log_depth, axis=0)) > EDGE
    count, pieces, stats, _ = cv2.connectedComponentsWithStats((mask & ~jump).astype(np.uint8), connectivity=4)
    areas = stats[1:, cv2.CC_STAT_AREA]
    largest = np.argsort(-areas, kind="stable")[:MOST_OBJECTS]
    renumbered = np.zeros(count, np.int32)
    for number, piece in enumerate(largest[areas[largest] >= LEAST_PIXELS]):
        renumbered[piece + 1] = number + 1
    numbers = renumbered[pieces]
    # Pixels on an edge join the largest piece beside them that they belong to.
    grown = cv2.dilate(np.where(numbers > 0, count - numbers, 0).astype(np.float32), np.ones((3, 3), np.uint8))
    joined = np.where(grown > 0, count - grown, 0).astype(np.int32)
    return np.where(mask & (numbers == 0), joined, numbers)


def _appearance_at(look: Float[Tensor, "4 h w"], mine: Bool[Tensor, "h w"]) -> Float[Tensor, "4 n"]:
    """Normalized brightness and colours of an image at some of its full-size pixels."""
    height, width = mine.shape
    y, x = torch.nonzero(mine, as_tuple=True)
    place = torch.stack([(x * 2 + 1) / width - 1, (y * 2 + 1) / height - 1], dim=-1)
    return sampled(look[None], place[None, None])[:, 0, 0]


class _Frame(NamedTuple):
    """A neighbouring frame: projection, appearance features, and time after the frame of the object (least gap = 1)."""

    view: ImageView
    look: Float[Tensor, "4 h w"]
    span: float


class _Object:
    """Some points of one object and their appearance features."""

    def __init__(self, points: Float[Tensor, "n 3"], look: Float[Tensor, "4 n"]) -> None:
        step = max(1, len(points) // SAMPLES)
        self.points, self.look = points[::step], look[:, ::step]

    def search(self, frames: list[_Frame], car_axes: Float[Tensor, "2 3"], width_px: int) -> Float[Tensor, " 3"]:
        """The shift in the least gap (metres, scene frame) that fits best; zero unless it beats standing still.

        Args:
            frames: the frames around.
            car_axes: forward and left of the car in the scene frame.
            width_px: of the smaller images.
        """
        view = frames[0].view
        distance = float((self.points - view.eye).norm(dim=-1).median())
        # Image width spans 2 in place units, so slope * width / 2 is the focal length in pixels; Z / f is a pixel in
        # metres.
        pixel_m = 2 / (view.lines[0].slope * width_px) * distance
        along = max(STEP_ALONG_M, STEP_ALONG_SHARE * distance)
        across = max(STEP_PX * pixel_m, FARTHEST_M[1] / MOST_STEPS)
        steps = car_axes.new_tensor([along, across])
        reach = (int(FARTHEST_M[0] / along), int(FARTHEST_M[1] / across))
        # Coarse to fine: a full grid over a few points, then 5 x 5 grids with ever smaller steps over all of them.
        best = car_axes.new_zeros(2)
        standing = least = self._cost(best[None], frames, car_axes)[0]
        every = max(1, len(self.points) // FIRST_SAMPLES)
        for _ in range(1 + ROUNDS):
            grid = torch.cartesian_prod(*(torch.arange(-n, n + 1, device=car_axes.device) for n in reach))
            tried = best + grid * steps
            cost = self._cost(tried, frames, car_axes, every)
            best, least = tried[cost.argmin()], cost.min()
            reach, steps, every = (2, 2), steps / FINER, 1
        # Standing still is the prior: texture that repeats must not send parked cars driving.
        return best @ car_axes if least < standing - BETTER else car_axes.new_zeros(3)

    def _cost(
        self, tried: Float[Tensor, "d 2"], frames: list[_Frame], car_axes: Float[Tensor, "2 3"], every: int = 1
    ) -> Float[Tensor, " d"]:
        """How badly each shift (along and across, metres) fits, about 0..1, comparing one point in ``every``."""
        points, own = self.points[::every], self.look[:, None, None, ::every]
        total = (tried.abs() / tried.new_tensor(FARTHEST_M)).sum(-1) * FAR_PENALTY
        for view, look, span in frames:
            seen = view.places_of_moved(points, span * (tried @ car_axes))
            # Truncated at 1 per channel: occluded points cost no more than a clear mismatch.
            difference = (sampled(look[None], seen.place) - own).abs().clamp(max=1).mean(0)
            total = total + torch.where(seen.inside, difference, OUTSIDE).mean((1, 2)) / len(frames)
        return total
