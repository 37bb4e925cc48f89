"""The context decoders and the two ways to decode Gaussians: dense and selective (paper section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from nurec_sim.network.attention import KeyValueProjector, QueryBlock
from nurec_sim.network.car_view import CHANNELS, MATCHED_DEPTH, car_view
from nurec_sim.network.dpt import DptHead
from nurec_sim.network.encoder import Features
from nurec_sim.network.footprints import Footprints, footprints
from nurec_sim.network.motion import MotionDecoder
from nurec_sim.network.pixel_detail import PixelDetail, chosen_depth, pixel_layers
from nurec_sim.network.profiles import Profile
from nurec_sim.network.tensors import SCENE_RESCALE, ContextMaps, NetworkInputs, QueryGaussians, SemanticClass

LARGEST_SCALE = 0.045
"""In the network's unit; 0.30 m."""
# A head output of 0 means a scale of exp(-2.9) times the largest, about 17 mm, and an opacity of sigmoid(-2), about
# 0.12: training starts with Gaussians that are small and nearly transparent.
SCALE_SHIFT = 2.9
OPACITY_SHIFT = 2.0
GAUSSIAN_CHANNELS = 8
"""Scale 3, quaternion 4, opacity 1."""


class ContextDecoder(nn.Module):
    """Depth, colour, normals, classes and motion of every input pixel; shared by both decoders."""

    cuboids_dims_padding: Tensor

    def __init__(self, profile: Profile) -> None:
        super().__init__()
        width = 2 * profile.encoder.width
        # Margin around cuboids, metres: part of the released state dicts, unused here.
        self.register_buffer("cuboids_dims_padding", torch.ones(3))
        self.depth_head = DptHead(width, profile.head, out=2)
        seen, wide = 3 + CHANNELS, profile.head.fused // 2
        detailed = profile.head.pixel_detail
        self.depth_fusion = PixelDetail(seen, wide) if detailed else None
        self.rgb_fusion: nn.Module = PixelDetail(seen, wide, near=3) if detailed else pixel_layers(3, wide)
        self.context_head = DptHead(width, profile.head, out=3 + 3 + len(SemanticClass))
        self.context_motion_head = MotionDecoder(profile)
        self.begins_as_footprints = profile.log_geometry

    def context(self, features: Sequence[Features], inputs: NetworkInputs, motion: bool) -> ContextMaps:
        """Maps of all images."""
        clips, size = inputs.rgb.shape[:2], (inputs.rgb.shape[2], inputs.rgb.shape[3])
        levels = [feature.patches.flatten(0, 1) for feature in features]
        images = inputs.rgb.flatten(0, 1).permute(0, 3, 1, 2)
        if self.depth_fusion is None:
            depth = self.depth_head(levels, size)[:, 0].float()
        else:
            view = car_view(inputs).flatten(0, 1).permute(0, 3, 1, 2)
            images = torch.cat([images, view.to(images.dtype)], dim=1)
            predicted, trust = self.depth_head(levels, size, self.depth_fusion, images).float().unbind(1)
            depth = chosen_depth(predicted, trust, view[:, MATCHED_DEPTH])
        context = self.context_head(levels, size, self.rgb_fusion, images).float().permute(0, 2, 3, 1)
        rgb, normal, logits = context.split([3, 3, len(SemanticClass)], dim=-1)
        # Motion has a transformer of its own, so it only runs on request.
        moved = None
        if motion:
            moved = self.context_motion_head(features, size, inputs.time, inputs.time_before, inputs.time_after)
        return ContextMaps(
            # The head predicts log z-depth in the network's unit (0.15 per metre): always positive, with relative
            # errors.
            depth_m=(depth.exp() / SCENE_RESCALE).unflatten(0, clips),
            # The release's activation: sigmoid(2x) = (1 + tanh x) / 2.
            rgb=torch.sigmoid(2 * rgb).unflatten(0, clips),
            normal=functional.normalize(normal, dim=-1).unflatten(0, clips),
            logits=logits.unflatten(0, clips),
            motion_m=moved,
        )


class DenseDecoder(ContextDecoder):
    """One Gaussian for every input pixel."""

    def __init__(self, profile: Profile) -> None:
        super().__init__(profile)
        self.gaussians_head = DptHead(2 * profile.encoder.width, profile.head, out=GAUSSIAN_CHANNELS)

    def gaussians(self, features: Sequence[Features], context: ContextMaps, inputs: NetworkInputs) -> QueryGaussians:
        """Gaussians of all pixels, in the order of (v, h, w)."""
        b, v, h, w = context.depth_m.shape
        raw = self.gaussians_head([feature.patches.flatten(0, 1) for feature in features], (h, w))
        raw = raw.float().permute(0, 2, 3, 1).reshape(b, v * h * w, GAUSSIAN_CHANNELS)
        source = torch.arange(v * h * w, device=raw.device).expand(b, -1)
        # The sky is a cubemap and the own car is no part of the scene: Gaussians of their pixels get opacity 0. A hard
        # mask, as in the release; it passes no gradient to the logits.
        visible = (outside_probability(context.logits) > 0.5).reshape(b, -1).to(raw.dtype)
        shapes = footprints(inputs, context, source, raw.new_ones(v * h * w)) if self.begins_as_footprints else None
        return gaussians_at(source, raw, visible, lifted_points(context, inputs), context, shapes)


class SelectiveDecoder(ContextDecoder):
    """Clusters of Gaussians around chosen points that attend to the features (point queries, paper section 3.3).

    Attributes:
        fill_road_slots: the release's rule instead of ours. It always has ``road_slots`` road tokens per image; unused
            ones hold cells that are not road, which still attend and are attended to, with opacity 0.
    """

    def __init__(self, profile: Profile) -> None:
        super().__init__(profile)
        self.size = profile.selective
        self.fill_road_slots = False
        width, points = 2 * profile.encoder.width, self.size.cell**2
        self.xyz_embed = nn.Sequential(nn.Linear(3 * points, width), nn.LayerNorm(width))
        self.ca_feature_norm = nn.LayerNorm(width)
        self.ca_kv_projector = KeyValueProjector(width, self.size.heads, normed=True)
        self.ca_blocks = nn.ModuleList(QueryBlock(width, self.size.heads, scale=1e-4) for _ in range(self.size.depth))
        self.ca_kv_proj = nn.Linear(len(profile.encoder.taps) * width, width, bias=False)
        # Each token decodes all M = p^2 Gaussians of its cell at once (paper section 3.3).
        self.gs_linear = nn.Linear(width, points * GAUSSIAN_CHANNELS)

    def gaussians(self, features: Sequence[Features], context: ContextMaps, inputs: NetworkInputs) -> QueryGaussians:
        """Clusters of strided points of all images, then full clusters on the road of all images.

        Raises:
            ValueError: more than one clip, whose numbers of clusters would differ.
        """
        if len(context.depth_m) != 1:
            raise ValueError(f"the selective decoder takes one clip at a time, got {len(context.depth_m)}")
        road, filled = self.road_cells(context.logits[0])
        regular = self.regular_cells(context.depth_m[0])
        source = torch.cat([regular, road]).flatten()[None]
        points = lifted_points(context, inputs)
        raw = self.decode(points.gather(1, source[..., None].expand(-1, -1, 3)), features)
        # m = 1 - p_ego - p_sky multiplies the opacity itself; the dense decoder thresholds it at 0.5. Both as released.
        visible = outside_probability(context.logits).reshape(1, -1).gather(1, source)
        visible[:, source.shape[1] - road.numel() :] *= filled.repeat_interleave(self.size.cell**2)
        shapes = None
        if self.begins_as_footprints:
            # Strided points are s pixels apart, so that their footprints must be s times as wide to leave no gaps.
            spacing = raw.new_ones(source.shape[1])
            spacing[: regular.numel()] = self.size.stride
            shapes = footprints(inputs, context, source, spacing)
        return gaussians_at(source, raw, visible, points, context, shapes)

    def decode(self, points: Float[Tensor, "b n 3"], features: Sequence[Features]) -> Float[Tensor, "b n 8"]:
        """Raw attributes of the Gaussians at points, whole clusters of ``cell``**2 after each other."""
        # Keys and values come from all four taps of all images of the clip, side by side: 4 x 1536 channels in the
        # release.
        stacked = torch.cat([feature.patches.flatten(1, 3) for feature in features], dim=-1)
        k, v = self.ca_kv_projector(self.ca_feature_norm(self.ca_kv_proj(stacked)))
        # One token per cluster: the points of a whole cell, side by side.
        x = self.xyz_embed(points.reshape(len(points), -1, 3 * self.size.cell**2))
        for block in self.ca_blocks:
            x = block(x, k, v)
        return self.gs_linear(x).float().reshape(*points.shape[:2], GAUSSIAN_CHANNELS)

    def regular_cells(self, like: Float[Tensor, "v h w"]) -> Int64[Tensor, "tokens points"]:
        """Pixels of the strided clusters; what is left over at the right and the bottom is not used."""
        index = torch.arange(like.numel(), device=like.device).reshape(like.shape)
        return _cells(index[:, :: self.size.stride, :: self.size.stride], self.size.cell).flatten(0, 1)

    def road_cells(
        self, logits: Float[Tensor, "v h w 5"]
    ) -> tuple[Int64[Tensor, "tokens points"], Bool[Tensor, " tokens"]]:
        """Pixels of the clusters on the road, and which of them are: all, but for ``fill_road_slots``.

        A cell qualifies if every pixel of it is road. Where more do than there are slots, they are taken evenly.
        """
        index = torch.arange(logits[..., 0].numel(), device=logits.device).reshape(logits.shape[:-1])
        cells = _cells(index, self.size.cell)
        # All pixels, not most (the release's rule): mixed cells are left to the regular tokens.
        road = _cells(logits.argmax(-1) == SemanticClass.ROAD, self.size.cell).all(-1)
        slots = min(self.size.road_slots, cells.shape[1])
        chosen, filled = [], []
        for image_cells, is_road in zip(cells, road, strict=True):
            ranked = torch.argsort(~is_road, stable=True)  # road cells first, in their order
            count = int(is_road.sum())
            if count > slots:
                # Evenly over the image and always the same; the release draws at random, so its results vary from run
                # to run.
                ranked = ranked[torch.arange(slots, device=ranked.device) * count // slots]
            taken = ranked[:slots] if self.fill_road_slots else ranked[: min(count, slots)]
            chosen.append(image_cells[taken])
            filled.append(is_road[taken])
        return torch.cat(chosen), torch.cat(filled)


def _cells(maps: Tensor, cell: int) -> Tensor:
    """Maps [v, h, w] as [v, cells, cell * cell], both in rows; incomplete cells are left out."""
    v, h, w = maps.shape
    rows, columns = h // cell, w // cell
    whole = maps[:, : rows * cell, : columns * cell].reshape(v, rows, cell, columns, cell)
    return whole.permute(0, 1, 3, 2, 4).reshape(v, rows * columns, cell * cell)


def lifted_points(context: ContextMaps, inputs: NetworkInputs) -> Float[Tensor, "b n 3"]:
    """Where each pixel's ray reaches its depth, scene frame, metres."""
    # Rays have unit length: distance is z-depth over the z of the ray.
    distance = context.depth_m[..., None] / inputs.distance_to_depth_scale
    return (inputs.rays[..., :3] + inputs.rays[..., 3:] * distance).flatten(1, 3)


def outside_probability(logits: Float[Tensor, "*n 5"]) -> Float[Tensor, "*n"]:
    """How probably a pixel shows something that Gaussians should show: neither the own car nor the sky."""
    probability = logits.softmax(-1)
    return 1 - probability[..., SemanticClass.EGO] - probability[..., SemanticClass.SKY]


def gaussians_at(
    source: Int64[Tensor, "b n"],
    raw: Float[Tensor, "b n 8"],
    visible: Float[Tensor, "b n"],
    points: Float[Tensor, "b pixels 3"],
    context: ContextMaps,
    shapes: Footprints | None,
) -> QueryGaussians:
    """Activated Gaussians at source pixels, with the pixels' colour, normal, class and motion.

    Args:
        source: flat (v, h, w) index of each Gaussian's pixel.
        raw: head output: log scale (3), quaternion wxyz (4), opacity logit (1).
        visible: factor on the opacity, 0..1.
        points: lifted points of all pixels, scene frame, metres.
        context: maps to take colour, normal, class and motion from.
        shapes: footprints that the outputs change relatively; None: they are absolute, as in the release.
    """
    log_scale, quaternion, opacity = raw.split([3, 4, 1], dim=-1)
    if shapes is None:
        # scale = min(exp(x + ln 0.045 - 2.9), 0.045) / 0.15 metres.
        log_scale = log_scale + (torch.tensor(LARGEST_SCALE).log() - SCALE_SHIFT)
        scale_m = log_scale.exp().clamp(max=LARGEST_SCALE) / SCENE_RESCALE
        quat_wxyz = functional.normalize(quaternion, dim=-1)
    else:
        scale_m, quat_wxyz = shapes.changed(log_scale, quaternion)

    def at_source(values: Tensor) -> Tensor:
        flat = values.reshape(source.shape[0], -1, *values.shape[4:])
        index = source.reshape(*source.shape, *[1] * (flat.ndim - 2)).expand(-1, -1, *flat.shape[2:])
        return flat.gather(1, index)

    return QueryGaussians(
        # No predicted offset: Gaussians lie on the lifted depth, and their colour is that of the pixel (SH degree 0).
        position_m=points.gather(1, source[..., None].expand(-1, -1, 3)),
        quat_wxyz=quat_wxyz,
        scale_m=scale_m,
        opacity=torch.sigmoid(opacity[..., 0] - OPACITY_SHIFT) * visible,
        rgb=at_source(context.rgb),
        normal=at_source(context.normal),
        semantic=at_source(context.logits.argmax(-1)),
        source=source,
        motion_m=None if context.motion_m is None else at_source(context.motion_m),
    )
