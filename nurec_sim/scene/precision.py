"""The precision of archives: half floats for everything but positions.

A half float has 11 significant bits. Its spacing at a distance of 64 to 128 m is 6 cm, so positions stay float32. What
remains is rounded by less than an 8-bit image or a LiDAR's intensity resolves: colours by 0.04 of 255 levels at most,
scales and opacities by 0.05 %, rotations by 0.05 degrees. Colours are stored as constant terms of spherical harmonics
(colour = 0.5 + SH_C0 * term), which every reader of ParticleFields needs.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Float16, Float32

from nurec_sim.scene.harmonics import SH_C0
from nurec_sim.types import Gaussians, GaussianScene

LARGEST = float(np.finfo(np.float16).max)
TERM_STEP = 2.0**-14
"""Constant terms are multiples of this. Half floats near 0 are closer together than the float32 colours made of them:
rounding twice would differ from rounding once."""
_HALF_FIELDS = ("quat_wxyz", "scale_m", "opacity", "normal", "intensity", "sh_rest", "ray_drop", "falloff")


def archived(scene: GaussianScene) -> GaussianScene:
    """The scene as an archive keeps it; a scene read from an archive is returned with the same values."""
    dynamic = dataclasses.replace(scene.dynamic, gaussians=_rounded(scene.dynamic.gaussians))
    sky = half(scene.sky).astype(np.float32)
    return dataclasses.replace(scene, static=_rounded(scene.static), dynamic=dynamic, sky=sky)


def half(values: Float[np.ndarray, "*n"]) -> Float16[np.ndarray, "*n"]:
    """Nearest half floats; what exceeds their range becomes the largest finite one."""
    return np.clip(values, -LARGEST, LARGEST).astype(np.float16, order="C")


def constant_terms(rgb: Float32[np.ndarray, "n 3"]) -> Float16[np.ndarray, "n 3"]:
    """Spherical-harmonics terms of degree 0 of display colours."""
    return half(np.rint((rgb.astype(np.float64) - 0.5) / SH_C0 / TERM_STEP) * TERM_STEP)


def colours(terms: Float16[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Display colours of terms of degree 0."""
    return (0.5 + SH_C0 * terms.astype(np.float64)).astype(np.float32)


def _rounded(gaussians: Gaussians) -> Gaussians:
    given = {name: getattr(gaussians, name) for name in _HALF_FIELDS}
    fields = {name: half(values).astype(np.float32) for name, values in given.items() if values is not None}
    return dataclasses.replace(gaussians, rgb=colours(constant_terms(gaussians.rgb)), **fields)
