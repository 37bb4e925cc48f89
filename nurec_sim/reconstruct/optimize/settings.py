"""Settings of the per-scene optimisation; learning rates are those of Adam at the start, per step."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class _Group:
    """Rates, weights or deviations: finite and 0 or more. Archives keep them, as JSON, which has no infinity.

    Raises:
        ValueError: one is not.
    """

    def __post_init__(self) -> None:
        """Checks them."""
        for name, value in dataclasses.asdict(self).items():
            if not 0 <= value < float("inf"):
                raise ValueError(f"{name} must be 0 or more and finite, got {value}")


@dataclass(frozen=True)
class LearningRates(_Group):
    """Step sizes at the start; all fall by ``OptimizeSettings.final_rate`` until the end of the budget."""

    mean: float = 0.2
    """Of means along the axes of their Gaussian, in its standard deviations along them."""
    turn_rad: float = 0.15
    """Of turns about the axes of a Gaussian; of a tilt of a disc, as much less as it is thin (``adam``)."""
    log_scale: float = 0.15
    logit_opacity: float = 0.05
    rgb: float = 0.02
    sky: float = 0.01
    response: float = 0.005
    """Of the logarithm of a frame's gains, and of its offsets."""


@dataclass(frozen=True)
class LossWeights(_Group):
    """Weights of the terms of the loss; each term is a mean over the pixels or returns that it concerns."""

    dssim: float = 0.2
    """Share of 1 - SSIM in the loss of colour; the rest is the absolute difference (Kerbl et al. 2023, eq. 7)."""
    depth: float = 0.5
    """Relative error of the rendered inverse depth at LiDAR returns."""
    solid: float = 0.02
    """1 - alpha at LiDAR returns."""
    sky: float = 0.02
    """Alpha where the start of the optimisation shows the sky."""
    surface: float = 0.2
    """1 - alpha where it shows surfaces."""
    opacity: float = 0.0
    """Mean opacity of the Gaussians in view (Kheradmand et al. 2024, with 0.01)."""
    scale: float = 0.0
    """Mean over the Gaussians in view of the sum of their standard deviations in metres (as above)."""
    response: float = 1e-3
    """Squares of a frame's log gains and offsets: how far a frame may differ from its camera."""


@dataclass(frozen=True)
class StartPriors(_Group):
    """Standard deviations of the errors that a Gaussian's values may have at the start; a large one does not hold."""

    mean: float = 0.6
    """Of means along the axes of their Gaussian, in its standard deviations along them."""
    log_scale: float = 0.6
    logit_opacity: float = 2.0
    rgb: float = 0.02

    def __post_init__(self) -> None:
        """Checks them: see ``_Group``.

        Raises:
            ValueError: one is 0.
        """
        super().__post_init__()
        for name, value in dataclasses.asdict(self).items():
            if value == 0:
                raise ValueError(f"{name} must be above 0: it is a standard deviation")


@dataclass(frozen=True)
class PosePriors(_Group):
    """Standard deviations of the errors that poses of images may have, and the weight of their squares in the loss."""

    turn_deg: float = 0.1
    shift_m: float = 0.02
    time_s: float = 0.002
    """Of a camera's clock."""
    weight: float = 1e-4


@dataclass(frozen=True)
class TrackPriors(_Group):
    """Standard deviations of the errors that labelled boxes may have, and the weight of their squares in the loss."""

    turn_deg: float = 2.0
    shift_m: float = 0.2
    weight: float = 1e-6


@dataclass(frozen=True)
class OptimizeSettings:
    """All settings of ``refine``.

    Attributes:
        seconds: wall time to spend, counted from the first step; None: no limit but ``steps``.
        steps: images to fit, one per step; None: no limit but ``seconds``. With both, the first to run out ends it.
        seed: of the order of images.
        final_rate: learning rates at the end of the budget, relative to those at its start.
        largest_m: no standard deviation may grow beyond this.
        voxel_px: static Gaussians of one label that share a voxel are merged before the fit (``optimize.merged``); its
            edge is so many pixels of the finest camera 10 m away, 0.07 m at most; 0: none.
        max_gaussians: voxels are larger where these leave more than so many; None: any number.
        rates: learning rates.
        weights: of the loss.
        start: how strongly Gaussians are held near the scene given.
        check_every: hold out every so many images of a camera to choose the best state by, where it has twice as many
            or more; 0: none, the last state counts.
        checkpoint: file for the state, written every ``checkpoint_s`` seconds and removed at the end; None: none.
        checkpoint_s: see checkpoint.
        resume: go on from the state in ``checkpoint``; budgets count from the very start.
        keep_interrupted: whether Ctrl-C ends the optimisation with the best state so far; else it is not caught.
        correct_poses: whether to correct the poses of images and the clocks of cameras.
        poses: how much.
        correct_tracks: whether to correct the tracks of rigid actors that move.
        tracks: how much.
        device: where images are drawn: ``auto``, ``cpu``, ``cuda`` or ``cuda:N`` (``render.choose_device``).
    """

    seconds: float | None = 300.0
    steps: int | None = None
    seed: int = 0
    final_rate: float = 0.1
    largest_m: float = 1.5
    voxel_px: float = 5.0
    max_gaussians: int | None = None
    rates: LearningRates = field(default_factory=LearningRates)
    weights: LossWeights = field(default_factory=LossWeights)
    start: StartPriors = field(default_factory=StartPriors)
    check_every: int = 16
    checkpoint: Path | None = None
    checkpoint_s: float = 60.0
    resume: bool = False
    keep_interrupted: bool = True
    correct_poses: bool = False
    poses: PosePriors = field(default_factory=PosePriors)
    correct_tracks: bool = True
    tracks: TrackPriors = field(default_factory=TrackPriors)
    device: str = "auto"

    def __post_init__(self) -> None:
        """Checks the budget.

        Raises:
            ValueError: no budget, or a budget, rate or bound that is not positive and finite.
        """
        if self.seconds is None and self.steps is None:
            raise ValueError("an optimisation needs a budget: seconds, steps or both")
        for name in ("seconds", "steps", "final_rate", "largest_m", "max_gaussians"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise ValueError(f"{name} must be positive and finite, got {value}")
        if not 0 <= self.voxel_px < float("inf"):
            raise ValueError(f"voxel_px must be 0 or more and finite, got {self.voxel_px}")
        if self.check_every < 0 or self.check_every == 1:
            raise ValueError(f"check_every must be 0 (none) or at least 2, got {self.check_every}")
        if self.resume and self.checkpoint is None:
            raise ValueError("resume needs a checkpoint")
