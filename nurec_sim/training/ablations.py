"""The ablations of the paper's Table 2 as changes of a recipe; each removes one component of the full training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from nurec_sim.errors import TrainingError
from nurec_sim.training.config import LossWeights, Part, Stage, TrainingConfig

SKY_MLP_PROFILES = {"tiny": "tiny-sky-mlp"}
"""Profiles that differ only in a sky MLP in place of the sky decoder."""
DEPTH_LOSSES = ("depth", "edges", "rendered_depth")
"""All losses that use the true depth."""


@dataclass(frozen=True)
class TableRow:
    """Columns of the paper's Table 2; depth figures are after scaling, smaller ``abs_rel`` is better."""

    psnr_db: float
    ssim: float
    abs_rel: float
    delta1: float


@dataclass(frozen=True)
class Ablation:
    """One row of the table.

    Attributes:
        text: the difference, for tables.
        paper: the paper's figures, on its own data.
        change: makes the ablated recipe from the full one.
        merge: how chunks are merged into one scene at inference; ``FeedForwardSettings.merge``.
    """

    text: str
    paper: TableRow
    change: Callable[[TrainingConfig], TrainingConfig]
    merge: Literal["ownership", "concatenate"] = "ownership"


def ablated(config: TrainingConfig, name: str) -> TrainingConfig:
    """The recipe of an ablation.

    Args:
        config: the full recipe.
        name: one of ``ABLATIONS``.

    Raises:
        TrainingError: there is no such ablation, or the recipe lacks the ablated component already.
    """
    if name not in ABLATIONS:
        raise TrainingError(f"no ablation {name!r}; have {list(ABLATIONS)}")
    change = ABLATIONS[name].change
    changed = change(config)
    if changed == config and change is not _unchanged:
        raise TrainingError(f"the recipe already trains without what {name!r} takes away")
    return changed


def scaled(config: TrainingConfig, steps: int, pixels: int) -> TrainingConfig:
    """A recipe reduced to ``steps`` total steps and at most ``pixels`` pixels per image; stages keep their shares.

    Raises:
        TrainingError: there are fewer steps than stages.
    """
    if steps < len(config.stages):
        raise TrainingError(f"{len(config.stages)} stages need at least as many steps, got {steps}")
    share = steps / config.steps
    ends = [round(share * sum(stage.steps for stage in config.stages[: k + 1])) for k in range(len(config.stages))]
    stages, first = [], 0
    for number, (stage, end) in enumerate(zip(config.stages, ends, strict=True)):
        last = min(max(end, first + 1), steps - (len(ends) - 1 - number))
        changes = {
            "steps": last - first,
            "warm_up": min(round(share * stage.warm_up), last - first - 1),
            "pixels": min(stage.pixels, pixels),
        }
        stages.append(stage.model_copy(update=changes))
        first = last
    return config.model_copy(update={"stages": tuple(stages)})


def _in_one_stage(config: TrainingConfig) -> TrainingConfig:
    """All parts and losses at once, for the same number of steps, with learning rate and warm-up of the first stage.

    A loss has its weight from the first stage to which it applies. Views are rendered in every step, so training takes
    longer, as in the paper.
    """
    if len(config.stages) == 1:
        return config
    first = config.stages[0]
    parts: tuple[Part, ...] = tuple(dict.fromkeys(part for stage in config.stages for part in stage.trains))
    weights = {name: _first_weight(name, config.stages) for name in LossWeights.model_fields}
    last = max(config.stages, key=lambda stage: stage.targets)
    changes = {
        "name": "joint",
        "steps": config.steps,
        "trains": parts,
        "pixels": last.pixels,
        "targets": last.targets,
        "losses": LossWeights(**weights),
    }
    return config.model_copy(update={"stages": (first.model_copy(update=changes),)})


def _first_weight(name: str, stages: tuple[Stage, ...]) -> float:
    return next((getattr(stage.losses, name) for stage in stages if _applies(name, stage)), 0.0)


def _applies(name: str, stage: Stage) -> bool:
    """Whether a stage computes a loss at all, regardless of its weight (``objective.Objective``)."""
    if name in ("depth", "edges", "normal", "semantic", "rgb"):
        return bool({"encoder", "context"} & set(stage.trains))
    if name in ("sky", "motion"):
        return name in stage.trains
    return stage.targets > 0


def _with_sky_mlp(config: TrainingConfig) -> TrainingConfig:
    if config.profile not in SKY_MLP_PROFILES:
        raise TrainingError(f"profile {config.profile!r} has no twin with a sky MLP; have {SKY_MLP_PROFILES}")
    return config.model_copy(update={"profile": SKY_MLP_PROFILES[config.profile]})


def _without(*losses: str) -> Callable[[TrainingConfig], TrainingConfig]:
    """Disables losses; stages that do not compute them are unchanged, so that variants can share them."""

    def without(stage: Stage) -> Stage:
        none = {name: 0.0 for name in losses if _applies(name, stage)}
        return stage.model_copy(update={"losses": stage.losses.model_copy(update=none)}) if none else stage

    return lambda config: config.model_copy(update={"stages": tuple(without(stage) for stage in config.stages)})


def _unchanged(config: TrainingConfig) -> TrainingConfig:
    return config


ABLATIONS: Mapping[str, Ablation] = {
    "full": Ablation("full", TableRow(29.93, 0.793, 0.069, 0.950), _unchanged),
    "single_stage": Ablation("single-stage training", TableRow(27.65, 0.751, 0.077, 0.955), _in_one_stage),
    "sky_mlp": Ablation("sky MLP instead of cubemap", TableRow(26.73, 0.692, 0.068, 0.950), _with_sky_mlp),
    "no_perceptual": Ablation("without perceptual loss", TableRow(26.81, 0.705, 0.073, 0.934), _without("perceptual")),
    "no_depth_loss": Ablation("without depth loss", TableRow(28.92, 0.782, 0.103, 0.862), _without(*DEPTH_LOSSES)),
    "concatenation": Ablation(
        "without frustum-ownership merging", TableRow(26.10, 0.648, 0.098, 0.891), _unchanged, "concatenate"
    ),
}
"""By name, in the order of the paper's table. ``concatenation`` needs no training of its own."""
