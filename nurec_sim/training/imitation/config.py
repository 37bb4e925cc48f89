"""Recipes of the end-to-end policies in YAML, strictly validated."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from nurec_sim.training.recipe_file import read_recipe, recipe_profile
from nurec_sim.training.settings import Strict

PROFILE = "imitation"


class DriveSettings(Strict):
    """Generated examples.

    Attributes:
        first_town: number of the first town of the split ``train``; the following ones come next.
        towns: number of towns.
        town_s: simulated traffic of each town.
        places: ego poses in each town at which images are rendered.
        answers: headings and speeds at each place, for which the expert answers; the images are turned, not rendered.
        beside_m: standard deviation of the distance from the recorded path, clipped to three times as much.
        turned_deg: standard deviation of the heading.
        shifted_s: the ego is up to this far ahead of or behind its recorded place, which changes gaps.
        blocked: probability that another vehicle is moved to somewhere near the route ahead.
    """

    first_town: int = Field(0, ge=0)
    towns: int = Field(24, ge=1)
    town_s: float = Field(12.0, ge=4, le=30)
    places: int = Field(40, ge=1)
    answers: int = Field(6, ge=1)
    beside_m: float = Field(0.5, ge=0)
    turned_deg: float = Field(3.0, ge=0)
    shifted_s: float = Field(1.0, ge=0)
    blocked: float = Field(0.5, ge=0, le=1)


class ImitationConfig(Strict):
    """A recipe. Every policy is trained for ``steps`` steps, and starts from the encoder of the one before it.

    Attributes:
        profile: tells the recipe from those of other networks.
        policies: names of the policies, in this order.
        seed: of weights, examples and their order.
        steps: optimiser steps per policy.
        batch: examples per step.
        learning_rate: the peak.
        warm_up: steps of its linear rise.
        final_rate: the last rate by the peak.
        weight_decay: of AdamW.
        clip_norm: the gradient is shortened to this norm.
        average: decay of the moving average that becomes the weights.
        route_noise_m: standard deviation of the error of the route at training, across it: the network must look.
        held_out: every so many towns one is kept for measuring the error.
        log_every: steps between rows of the curves.
        checkpoint_every: steps between checkpoints.
        data: the examples.
    """

    profile: Literal["imitation"] = "imitation"
    policies: tuple[str, ...] = ("e2e_1cam", "e2e_2cam", "e2e_4cam")
    seed: int = Field(0, ge=0)
    steps: int = Field(500, ge=1)
    batch: int = Field(32, ge=1)
    learning_rate: float = Field(1e-3, gt=0, le=1)
    warm_up: int = Field(50, ge=0)
    final_rate: float = Field(0.02, ge=0, le=1)
    weight_decay: float = Field(0.05, ge=0)
    clip_norm: float = Field(1.0, gt=0)
    average: float = Field(0.99, ge=0, lt=1)
    route_noise_m: float = Field(0.35, ge=0)
    held_out: int = Field(8, ge=2)
    log_every: int = Field(20, ge=1)
    checkpoint_every: int = Field(100, ge=1)
    data: DriveSettings = DriveSettings()

    @model_validator(mode="after")
    def _distinct(self) -> ImitationConfig:
        if not self.policies or len(set(self.policies)) != len(self.policies):
            raise ValueError(f"policies must be different names, got {list(self.policies)}")
        return self

    def digest(self) -> str:
        """SHA-256 of the recipe, in hex."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()


def is_imitation_recipe(path: Path) -> bool:
    """Whether a recipe trains end-to-end policies; False also where it cannot be read."""
    return recipe_profile(path) == PROFILE


def read_imitation_config(path: Path) -> ImitationConfig:
    """A recipe from its file.

    Raises:
        TrainingError: the file cannot be read, or a key is missing, misspelt or out of range.
    """
    return read_recipe(path, ImitationConfig)
