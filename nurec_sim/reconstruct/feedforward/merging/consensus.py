"""One world from the images of a chunk: a surface seen by several lies in one place and is shown by one of them.

The network predicts depth, class and colour image by image. Put into one world, the surfaces of many images lie in
front of one another, and wrong ones hide right ones. So:

- a place that enough of the images seeing it classify as movable is movable for all of them;
- among static points, an image owns what it sees from nearest, by rings of distance, as in ``lift``; others move their
  points to the owner's depth, and then leave the surface to it;
- a point that more images look through than agree with is dropped; images count more the nearer they are;
- images that agree mix their colours, and cameras are brought to the same brightness (``exposures``).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64, UInt8

from nurec_sim.network.depth_change import with_changed_depth
from nurec_sim.network.tensors import NetworkInputs, NetworkOutputs, QueryGaussians, SemanticClass
from nurec_sim.reconstruct.feedforward.merging.comparison import (
    MOVABLE,
    SKY,
    SURFACE,
    UNKNOWN,
    Pictures,
    compare,
    views_of,
)
from nurec_sim.reconstruct.feedforward.merging.exposures import camera_gains

MOVES = 2
"""How often points are moved to their owner's depth, which moves too."""
MOVABLE_SHARE = 0.2
"""From this share of those that see it on, a place is movable. Below one half, as errors differ in cost: a mover taken
as static is seen doubled, a static thing taken as movable is only shown by fewer images."""
_KIND_OF_CLASS = np.full(len(SemanticClass), SURFACE, np.uint8)
_KIND_OF_CLASS[SemanticClass.MOVABLE] = MOVABLE
_KIND_OF_CLASS[SemanticClass.SKY] = SKY
_KIND_OF_CLASS[SemanticClass.EGO] = UNKNOWN


@dataclass(frozen=True)
class Consensus:
    """What the images agree on.

    Attributes:
        factor: from each pixel's depth to the agreed one.
        shown: whether the pixel shows its surface, and not another image.
        semantic: ``SemanticClass`` of each pixel.
        rgb: colour of each pixel's surface, cameras made alike.
        gain: what makes them alike, a factor to the canonical colours of each camera, at most 1.
    """

    factor: Float32[np.ndarray, "v h w"]
    shown: Bool[np.ndarray, "v h w"]
    semantic: Int64[np.ndarray, "v h w"]
    rgb: Float32[np.ndarray, "v h w 3"]
    gain: Float32[np.ndarray, "cameras 3"]

    def apply(self, gaussians: QueryGaussians, inputs: NetworkInputs) -> QueryGaussians:
        """Gaussians with the agreed positions and classes; those that are not shown get opacity 0."""
        device, source = gaussians.source.device, gaussians.source
        moved = with_changed_depth(gaussians, inputs, torch.from_numpy(self.factor).to(device))
        shown = torch.from_numpy(self.shown).to(device).reshape(-1)[source]
        semantic = torch.from_numpy(self.semantic).to(device).reshape(-1)[source]
        return dataclasses.replace(moved, opacity=moved.opacity * shown, semantic=semantic)

    def coloured(self, outputs: NetworkOutputs, inputs: NetworkInputs) -> NetworkOutputs:
        """Outputs in colours that all cameras share; adjusted responses show them as each camera did before."""
        device = outputs.isp.device
        gain = torch.from_numpy(self.gain).to(device)
        rgb = torch.from_numpy(self.rgb).to(device).reshape(-1, 3)[outputs.gaussians.source]
        of_image = gain[inputs.camera_idxs[0].to(device)][None, :, None, None]
        return dataclasses.replace(
            outputs,
            context=dataclasses.replace(outputs.context, rgb=outputs.context.rgb * of_image),
            gaussians=dataclasses.replace(outputs.gaussians, rgb=rgb.to(outputs.gaussians.rgb.dtype)),
            sky=outputs.sky * gain[0],
            # A (c g) / g + b: the shown colour is unchanged.
            isp=torch.cat([outputs.isp[..., :3] / gain[None, :, None], outputs.isp[..., 3:]], dim=-1),
        )


def find_consensus(
    inputs: NetworkInputs,
    depth_m: Float32[np.ndarray, "v h w"],
    semantic: Int64[np.ndarray, "v h w"],
    rgb: Float32[np.ndarray, "v h w 3"],
    ego: Bool[np.ndarray, "v h w"] | None = None,
    stands: Bool[np.ndarray, "v h w"] | None = None,
) -> Consensus:
    """Compare every image with the others.

    Args:
        inputs: the images, b = 1.
        depth_m: their depth, along the optical axis.
        semantic: their ``SemanticClass``; what can move, sky and the own car keep their depth and are always shown.
        rgb: their canonical colours.
        ego: pixels known to show the own car, whatever their class.
        stands: movable pixels that seem to show something static; those on which the images agree become ``OTHERS``,
            the rest remain movable.
    """
    views, camera = views_of(inputs), inputs.camera_idxs[0].cpu().numpy()
    stands = np.zeros(semantic.shape, np.bool_) if stands is None else stands
    semantic = np.where(stands, int(SemanticClass.OTHERS), semantic)
    kind = _KIND_OF_CLASS[semantic]
    if ego is not None:
        kind[ego] = UNKNOWN
    depth_m, rgb = np.ascontiguousarray(depth_m, np.float32), np.ascontiguousarray(rgb, np.float32)
    pictures = Pictures(depth_m, kind, np.ones(kind.shape, np.bool_), rgb, camera)

    first = compare(pictures, views)
    voted = _voted(kind, first.movable)
    # From the first comparison, before colours are mixed: mixing would average the difference away.
    gain = camera_gains(camera, first.pairs)
    pictures = pictures._replace(kind=voted, rgb=rgb * gain[camera][:, None, None])
    # Owners move too (to the owner of their own place), so one pass does not settle; two nearly do.
    for _ in range(MOVES):
        compared = compare(pictures, views)
        pictures = pictures._replace(depth_m=compared.depth_m)
    # Points that were voted down must not own: their surface would be dropped, and nobody else would show it.
    last = compare(pictures._replace(may_own=compared.agreed), views)

    semantic = np.where((kind == MOVABLE) & (voted == SURFACE), int(SemanticClass.OTHERS), semantic)
    semantic = np.where((kind == SURFACE) & (voted == MOVABLE), int(SemanticClass.MOVABLE), semantic)
    moves = stands & (voted == SURFACE) & ~last.agreed
    semantic[moves] = SemanticClass.MOVABLE
    factor = np.where(moves, np.float32(1), pictures.depth_m / depth_m)
    return Consensus(factor, last.owned & last.agreed | moves, semantic, last.rgb, gain)


def _voted(kind: UInt8[np.ndarray, "v h w"], movable: Float32[np.ndarray, "v h w"]) -> UInt8[np.ndarray, "v h w"]:
    """Kinds after the vote on what can move."""
    votes = (kind == SURFACE) | (kind == MOVABLE)
    return np.where(votes, np.where(movable > MOVABLE_SHARE, MOVABLE, SURFACE), kind).astype(np.uint8)
