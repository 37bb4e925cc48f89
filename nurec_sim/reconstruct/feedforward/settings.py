"""Settings of the feed-forward reconstruction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nurec_sim.errors import ReconstructError


@dataclass(frozen=True)
class FeedForwardSettings:
    """How a clip goes through the network.

    Attributes:
        profile: size of the network, one that ``nurec-sim weights list`` shows; None takes the method's small one.
        checkpoint: file with weights; None takes the profile's own (docs/network.md).
        random_weights: seed of random weights instead of any file, for tests and timings; None reads weights.
        device: ``auto`` takes a GPU if there is one.
        precision: of matrix products and convolutions; ``auto`` is float32 on a CPU and half precision on a GPU.
        chunking: ``overlapping`` chunks as in the paper, or the release's ``non-overlapping`` sampling.
        overlap: share of a chunk that the next one repeats, 0 up to 0.5 (only ``overlapping``).
        frames: most frames per camera and chunk; None takes the profile's.
        image_pixels: about how many pixels each image has on its way in; None takes the profile's size. Only profiles
            that keep the cameras' aspect can have others.
        max_chunks: refuse longer clips instead of running for hours.
        min_opacity: Gaussians below are dropped (paper section 3.4).
        merge: ``ownership`` keeps each static Gaussian only where its chunk saw it from nearest, and each vehicle with
            a box once; ``concatenate`` keeps all Gaussians of all images.
        ownership_tolerance_m: how much farther than the nearest chunk an owner may be.
        max_gaussians: static Gaussians are merged into voxels until at most so many are left; None keeps all. Ground
            that only sweeps show is added to them.
        lidar_depth: how predicted depth is fitted to the log's sweeps, per frame: not at all (``off``), by a factor
            (``scale``), by a factor and a slope over inverse depth (``affine``), or by a factor and a field of factors
            that follow the points from surface to surface (``local``).
        road_labels: what tells road from other ground: the ``network`` or steps in the sweeps (``lidar``), which then
            also add the ground that no image shows; ``auto`` takes the sweeps if there are any.
        consensus: whether the images of a chunk agree on where a surface lies, which of them shows it, in what colour,
            and what can move; without, all of them show it where each sees it, as in the paper.
        ego_masks: folder with ``<camera>.png``: pixels of the car's own body, not black where it covers the view.
        sky_px: edge of the scene's sky cubemap.
        learned_sky: whether the sky that no image shows comes from the profile's sky decoder, if it has one.
    """

    profile: str | None = None
    checkpoint: Path | None = None
    random_weights: int | None = None
    device: str = "auto"
    precision: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    chunking: Literal["overlapping", "non-overlapping"] = "overlapping"
    overlap: float = 0.25
    frames: int | None = None
    image_pixels: int | None = None
    max_chunks: int = 16
    min_opacity: float = 0.01
    merge: Literal["ownership", "concatenate"] = "ownership"
    ownership_tolerance_m: float = 5.0
    max_gaussians: int | None = 2_000_000
    lidar_depth: Literal["off", "scale", "affine", "local"] = "off"
    road_labels: Literal["auto", "network", "lidar"] = "auto"
    consensus: bool = True
    ego_masks: Path | None = None
    sky_px: int = 256
    learned_sky: bool = True

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            ReconstructError: a value out of range.
        """
        ranges = {
            "overlap": (0.0, 0.5),
            "max_chunks": (1, 10_000),
            "min_opacity": (0.0, 1.0),
            "ownership_tolerance_m": (0.0, float("inf")),
            "sky_px": (8, 4096),
        }
        if self.frames is not None:
            ranges["frames"] = (1, 1000)
        if self.image_pixels is not None:
            ranges["image_pixels"] = (784, 4_000_000)
        if self.max_gaussians is not None:
            ranges["max_gaussians"] = (1, float("inf"))
        for name, (least, most) in ranges.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise ReconstructError(f"{name} must lie in {least:g}..{most:g}, got {value!r}")
