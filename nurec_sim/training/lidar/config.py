"""Recipes of the LiDAR branch in YAML, strictly validated."""

from __future__ import annotations

import hashlib
from pathlib import Path

from pydantic import Field, model_validator

from nurec_sim.errors import TrainingError
from nurec_sim.network.lidar.profiles import LIDAR_PROFILES
from nurec_sim.training.recipe_file import read_recipe, recipe_profile
from nurec_sim.training.settings import Strict

WITHOUT_FLOOR = {"lidar": "lidar-no-floor"}


class ScanSettings(Strict):
    """Generated sweeps.

    Attributes:
        first_town: number of the first town of the split ``train``; the following ones come next.
        towns: number of towns.
        places: instants of each town's drive at which sweeps are measured.
        targets: sweeps measured at the same instant from other poses.
        ahead_m: targets are up to this far ahead or behind.
        beside_m: and up to this far beside.
        noise_m: range noise of input sweeps, at most; each place has its own.
        sector_deg: part of a turn that a sample has.
        target_share: part of this sector, around its middle, that is rendered.
    """

    first_town: int = Field(0, ge=0)
    towns: int = Field(40, ge=1)
    places: int = Field(4, ge=1)
    targets: int = Field(2, ge=1)
    ahead_m: float = Field(5.0, ge=0)
    beside_m: float = Field(3.0, ge=0)
    noise_m: float = Field(0.03, ge=0)
    sector_deg: float = Field(120.0, gt=0, le=360)
    target_share: float = Field(0.5, gt=0, le=1)


class ScanLosses(Strict):
    """Weights of the loss terms; 0 disables a term. The paper's are ``range`` (L1) and ``intensity`` (MSE)."""

    range: float = Field(1.0, ge=0)
    intensity: float = Field(10.0, ge=0)
    alpha: float = Field(0.3, ge=0)
    drop: float = Field(0.1, ge=0)
    label: float = Field(0.1, ge=0)


class LidarTrainingConfig(Strict):
    """A recipe. ``average`` is the decay of the moving average that becomes the weights."""

    profile: str = "lidar"
    seed: int = Field(0, ge=0)
    steps: int = Field(1500, ge=1)
    learning_rate: float = Field(1e-3, gt=0, le=1)
    warm_up: int = Field(50, ge=0)
    final_rate: float = Field(0.02, ge=0, le=1)
    weight_decay: float = Field(0.01, ge=0)
    clip_norm: float = Field(1.0, gt=0)
    average: float = Field(0.99, ge=0, lt=1)
    log_every: int = Field(20, ge=1)
    checkpoint_every: int = Field(100, ge=1)
    data: ScanSettings = ScanSettings()
    losses: ScanLosses = ScanLosses()

    @model_validator(mode="after")
    def _known(self) -> LidarTrainingConfig:
        if self.profile not in LIDAR_PROFILES:
            raise ValueError(f"no LiDAR profile {self.profile!r}; have {list(LIDAR_PROFILES)}")
        return self

    def digest(self) -> str:
        """SHA-256 of the recipe, in hex."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    def without_floor(self) -> LidarTrainingConfig:
        """The same recipe for the profile without the scale floor.

        Raises:
            TrainingError: the profile has no such twin.
        """
        if self.profile not in WITHOUT_FLOOR:
            raise TrainingError(f"profile {self.profile!r} has no twin without a scale floor; have {WITHOUT_FLOOR}")
        return self.model_copy(update={"profile": WITHOUT_FLOOR[self.profile]})


def is_lidar_recipe(path: Path) -> bool:
    """Whether a recipe's profile is one of the LiDAR branch; False also where it cannot be read."""
    return recipe_profile(path) in LIDAR_PROFILES


def read_lidar_config(path: Path) -> LidarTrainingConfig:
    """A recipe from its file.

    Raises:
        TrainingError: the file cannot be read, or a key is missing, misspelt or out of range.
    """
    return read_recipe(path, LidarTrainingConfig)
