"""Recipes of the camera detector in YAML, strictly validated."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Literal

from pydantic import Field

from nurec_sim.training.recipe_file import read_recipe, recipe_profile
from nurec_sim.training.settings import Strict

PROFILE = "detector"


class SceneSettings(Strict):
    """Generated images.

    Attributes:
        first_town: number of the first town of the split ``train``; the following ones come next.
        towns: number of towns.
        town_s: simulated traffic of each town.
        images: of each town, at random instants.
        beside_m: standard deviation of the distance from the recorded path, clipped to twice as much.
        turned_deg: standard deviation of the camera's yaw, clipped to twice as much.
    """

    first_town: int = Field(0, ge=0)
    towns: int = Field(100, ge=2)
    town_s: float = Field(12.0, ge=4, le=30)
    images: int = Field(24, ge=1)
    beside_m: float = Field(1.0, ge=0)
    turned_deg: float = Field(8.0, ge=0)


class DetectorConfig(Strict):
    """A recipe.

    Attributes:
        profile: tells the recipe from those of other networks.
        seed: of weights, samples and their order.
        steps: optimiser steps.
        batch: images per step.
        learning_rate: the peak.
        warm_up: steps of its linear rise.
        final_rate: the last rate by the peak.
        weight_decay: of AdamW.
        clip_norm: the gradient is shortened to this norm.
        average: decay of the moving average that becomes the weights.
        held_out: every so many towns one is kept for the figures of the curves and for the threshold of the scores.
        log_every: steps between rows of the curves.
        checkpoint_every: steps between checkpoints.
        data: the images.
    """

    profile: Literal["detector"] = "detector"
    seed: int = Field(0, ge=0)
    steps: int = Field(1200, ge=1)
    batch: int = Field(16, ge=1)
    learning_rate: float = Field(2e-3, gt=0, le=1)
    warm_up: int = Field(100, ge=0)
    final_rate: float = Field(0.01, ge=0, le=1)
    weight_decay: float = Field(0.02, ge=0)
    clip_norm: float = Field(10.0, gt=0)
    average: float = Field(0.99, ge=0, lt=1)
    held_out: int = Field(10, ge=2)
    log_every: int = Field(20, ge=1)
    checkpoint_every: int = Field(100, ge=1)
    data: SceneSettings = SceneSettings()

    def digest(self) -> str:
        """SHA-256 of the recipe, in hex."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()


def is_detector_recipe(path: Path) -> bool:
    """Whether a recipe trains the detector; False also where it cannot be read."""
    return recipe_profile(path) == PROFILE


def read_detector_config(path: Path) -> DetectorConfig:
    """A recipe from its file.

    Raises:
        TrainingError: the file cannot be read, or a key is missing, misspelt or out of range.
    """
    return read_recipe(path, DetectorConfig)
