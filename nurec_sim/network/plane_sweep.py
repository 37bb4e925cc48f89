"""Depth by matching: how well every pixel fits its camera's other frames, for depths from near to far (a plane sweep).

Nothing is learned. Images are compared where their own brightness has been divided out, in small windows; what moves,
has no texture or lies where the car drives to does not match, and says so by a low confidence.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nurec_sim.network.tensors import SCENE_RESCALE, NetworkInputs

NEAREST_M, FARTHEST_M, DEPTHS = 2.0, 120.0, 48
"""Depths are tried in equal steps of their logarithm, each 9 % farther than the last."""
NEIGHBOURS = (-1, 1, -2)
"""Frames of the same camera to compare with, by their places in the order of time."""
SHRINK = 2
WINDOW_PX = 9
SHARPNESS = 25.0
"""How strongly the best match is preferred to the others."""
OUTSIDE = 0.3
"""Badness of a depth whose point the other image does not show: neither a good match nor a bad one."""
AGREEING = 0.15
"""Two images agree on a point if the logarithms of its depth differ by less; the confidence of others is cut down."""
ALONE = 0.15
"""Share of the confidence that is left where no other image agrees."""
LENS_STEPS = 2
LEAST_CONTRAST = 0.02
"""Below this deviation within a window, brightness in 0..1 is noise."""


@torch.no_grad()
def plane_sweep(inputs: NetworkInputs) -> Float[Tensor, "b v h w 2"]:
    """Logarithm of the matched depth in the network's unit, and its confidence in 0..1 (0: nothing to compare with)."""
    return torch.stack([_clip_sweep(inputs, clip) for clip in range(len(inputs.rgb))])


def _clip_sweep(inputs: NetworkInputs, clip: int) -> Float[Tensor, "v h w 2"]:
    rgb, rays = inputs.rgb[clip].float(), inputs.rays[clip].float()
    v, height, width = rgb.shape[:3]
    size = (max(1, height // SHRINK), max(1, width // SHRINK))
    grey = functional.interpolate(rgb.mean(-1)[:, None], size, mode="area")
    local = _locally_normalized(grey)
    small = functional.interpolate(rays.permute(0, 3, 1, 2), size, mode="bilinear", antialias=True).permute(0, 2, 3, 1)
    along = functional.interpolate(
        inputs.distance_to_depth_scale[clip].float().permute(0, 3, 1, 2), size, mode="bilinear", antialias=True
    )[:, 0]
    views = [_View(small[k], inputs.c2w[clip, k].float()) for k in range(v)]
    log_m = torch.linspace(math.log(NEAREST_M), math.log(FARTHEST_M), DEPTHS, device=rgb.device)
    camera, time = inputs.camera_idxs[clip], inputs.time[clip]
    maps = []
    for k in range(v):
        distance = log_m.exp()[:, None, None] / along[k].clamp(min=1e-3)
        direction = functional.normalize(small[k, ..., 3:], dim=-1)
        points = small[k, ..., :3] + distance[..., None] * direction
        costs = [_cost(points, local[k], local[n], views[n]) for n in _neighbours(camera, time, k)]
        maps.append(_chosen(torch.stack(costs), log_m) if costs else _nothing(size, log_m))
    found = torch.stack(maps)
    agreed = [_agreement(found, small[k], along[k], views, k, _neighbours(camera, time, k)) for k in range(v)]
    found[..., 1] *= torch.stack(agreed)
    found[..., 0] += math.log(SCENE_RESCALE)
    return functional.interpolate(found.permute(0, 3, 1, 2), (height, width), mode="nearest").permute(0, 2, 3, 1)


class _View:
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

    def places(self, points: Float[Tensor, "d h w 3"]) -> tuple[Float[Tensor, "d h w 2"], Tensor]:
        """Where points are seen, and whether they are."""
        local = (points - self.eye) @ self.turn
        z = local[..., 2]
        wanted = local[..., :2] / z.clamp(min=0.1)[..., None]
        slope = wanted.new_tensor([line[0] for line in self.lines])
        start = wanted.new_tensor([line[1] for line in self.lines])
        place = wanted * slope + start
        for _ in range(LENS_STEPS):
            reached = _sampled(self.plane, place)
            place = place + (wanted - reached.permute(1, 2, 3, 0)) * slope
        inside = (z > 0.3) & (place.abs() < 1).all(-1)
        return place, inside


def _line(plane: Tensor, place: Tensor) -> tuple[float, float]:
    """Slope and start of the places over coordinates in the image plane at z = 1, by least squares."""
    away = plane - plane.mean()
    slope = float((away * place).sum() / (away**2).sum().clamp(min=1e-9))
    return slope, float(place.mean() - slope * plane.mean())


def _sampled(values: Float[Tensor, "1 c h w"], place: Float[Tensor, "d h w 2"]) -> Float[Tensor, "c d h w"]:
    d, h, w = place.shape[:3]
    flat = place.reshape(1, d * h, w, 2)
    sampled = functional.grid_sample(values, flat, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled[0].reshape(-1, d, h, w)


def _locally_normalized(grey: Float[Tensor, "v 1 h w"]) -> Float[Tensor, "v 1 h w"]:
    """Brightness without the mean and the deviation of its window; nearly 0 where there is no texture."""
    mean = _window_mean(grey)
    deviation = (_window_mean(grey**2) - mean**2).clamp(min=0).sqrt()
    return (grey - mean) / (deviation + LEAST_CONTRAST)


def _window_mean(values: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    return functional.avg_pool2d(values, WINDOW_PX, 1, WINDOW_PX // 2, count_include_pad=False)


def _neighbours(camera: Tensor, time: Tensor, image: int) -> list[int]:
    """Images of the same camera around one."""
    same = torch.nonzero(camera == camera[image]).flatten().tolist()
    order = sorted(same, key=lambda k: (float(time[k]), k))
    place = order.index(image)
    return [order[place + step] for step in NEIGHBOURS if 0 <= place + step < len(order)]


def _cost(
    points: Float[Tensor, "d h w 3"], own: Float[Tensor, "1 h w"], other: Float[Tensor, "1 h w"], view: _View
) -> Float[Tensor, "d h w"]:
    """How badly each depth fits, 0..1."""
    place, inside = view.places(points)
    difference = (_sampled(other[None], place)[0] - own).abs().clamp(max=2) / 2
    return torch.where(inside, _window_mean(difference[:, None])[:, 0], OUTSIDE)


def _agreement(
    found: Float[Tensor, "v h w 2"],
    rays: Float[Tensor, "h w 6"],
    along: Float[Tensor, "h w"],
    views: list[_View],
    image: int,
    neighbours: list[int],
) -> Float[Tensor, "h w"]:
    """1 where a neighbour has found the same point, ``ALONE`` elsewhere."""
    distance = found[image, ..., 0].exp() / along.clamp(min=1e-3)
    points = rays[..., :3] + distance[..., None] * functional.normalize(rays[..., 3:], dim=-1)
    same = torch.zeros_like(distance, dtype=torch.bool)
    for n in neighbours:
        place, inside = views[n].places(points[None])
        depth = ((points - views[n].eye) @ views[n].turn)[..., 2].clamp(min=1e-3).log()
        theirs = functional.grid_sample(found[n, None, None, ..., 0], place, mode="nearest", align_corners=False)
        same |= inside[0] & ((theirs[0, 0] - depth).abs() < AGREEING)
    return torch.where(same, 1.0, ALONE)


def _chosen(costs: Float[Tensor, "n d h w"], log_m: Float[Tensor, " d"]) -> Float[Tensor, "h w 2"]:
    """Mean of the log depths weighted by how well they fit, and how much weight lies around it."""
    best = costs.sort(dim=0).values[: max(1, (len(costs) + 1) // 2)].mean(0)
    weight = (-SHARPNESS * best).softmax(0)
    peak = weight.argmax(0)
    near = (torch.arange(len(log_m), device=peak.device)[:, None, None] - peak).abs() <= 2
    around = weight * near
    share = around.sum(0)
    return torch.stack([(around * log_m[:, None, None]).sum(0) / share, share], dim=-1)


def _nothing(size: tuple[int, int], log_m: Tensor) -> Float[Tensor, "h w 2"]:
    """Of an image without neighbours: the farthest depth, with no confidence."""
    return torch.stack([log_m.new_full(size, float(log_m[-1])), log_m.new_zeros(size)], dim=-1)
