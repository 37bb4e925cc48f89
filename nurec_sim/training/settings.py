"""The data part of a recipe: number and settings of the generated clips, and sampling from them."""

from __future__ import annotations

import dataclasses

from pydantic import BaseModel, ConfigDict, Field

from nurec_sim.network.profiles import Profile
from nurec_sim.training.data.augment import AugmentSettings
from nurec_sim.training.data.generate import ClipSettings
from nurec_sim.training.data.windows import WindowSettings


class Strict(BaseModel):
    """A part of a recipe: frozen, and unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class DataSettings(Strict):
    """Training data, generated on the fly.

    Attributes:
        clips: number of clips in the cache.
        clips_per_town: drives through each town.
        clip_frames: frames of every camera of a clip.
        clip_period_us: frame interval.
        clip_pixels: approximate number of pixels of rendered images.
        first_town: number of the first town; the following ones come next.
        refresh: whether new clips replace the oldest ones once the cache is full; runs are then not reproducible.
        cameras: sampling weight of each number of cameras in a sample.
        frames: sampling weight of each number of context frames per camera.
        most_images: maximum number of images of a sample.
        zoom: maximum magnification by random crops.
        mirror: probability of mirroring left and right.
        colours: whether colours are augmented (camera response, blur, noise, JPEG).
    """

    clips: int = Field(240, ge=1)
    clips_per_town: int = Field(3, ge=1)
    clip_frames: int = Field(16, ge=2)
    clip_period_us: int = Field(125_000, ge=10_000)
    clip_pixels: int = Field(65_856, ge=12_544)
    first_town: int = Field(0, ge=0)
    refresh: bool = False
    cameras: dict[int, float] = {1: 0.6, 3: 0.4}
    frames: dict[int, float] = {2: 0.1, 3: 0.1, 4: 0.7, 6: 0.1}
    most_images: int = Field(6, ge=1)
    zoom: float = Field(1.4, ge=1)
    mirror: float = Field(0.5, ge=0, le=1)
    colours: bool = True

    def clip_settings(self) -> ClipSettings:
        """Settings of the generated clips."""
        return ClipSettings(
            frames=self.clip_frames,
            period_us=self.clip_period_us,
            pixels=self.clip_pixels,
            clips_per_town=self.clips_per_town,
        )

    def window_settings(self, profile: Profile, pixels: int, targets: int) -> WindowSettings:
        """Settings of samples with about ``pixels`` pixels per image and ``targets`` views to render."""
        share = (pixels / (profile.width_px * profile.height_px)) ** 0.5
        sized = dataclasses.replace(
            profile, width_px=round(profile.width_px * share), height_px=round(profile.height_px * share)
        )
        return WindowSettings(
            profile=sized,
            cameras=self.cameras,
            frames=self.frames,
            most_images=self.most_images,
            targets=targets,
            zoom=self.zoom,
            mirror=self.mirror,
            augment=AugmentSettings() if self.colours else None,
        )
