"""The precision of archives: float32 for positions, bytes for what a LiDAR tells, half floats for everything else.

A half float has 11 significant bits. Its spacing at a distance of 64 to 128 m is 6 cm, so positions stay float32. What
remains is rounded by less than an 8-bit image resolves: colours by 0.04 of 255 levels at most, scales and opacities by
0.05 %, rotations by 0.05 degrees. Colours are stored as constant terms of spherical harmonics (colour = 0.5 + SH_C0 *
term), which every reader of ParticleFields needs. LiDARs report intensity in bytes; so are intensity and ray drop kept.
The normal of a disc is its third axis: normals that are, within ``AXIS_TOLERANCE``, are that axis exactly.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Float16, Float32, UInt8

from nurec_sim.scene.harmonics import SH_C0
from nurec_sim.types import Gaussians, GaussianScene

LARGEST = float(np.finfo(np.float16).max)
TERM_STEP = 2.0**-14
"""Constant terms are multiples of this. Half floats near 0 are closer together than the float32 colours made of them:
rounding twice would differ from rounding once."""
LEVELS = 254
"""The byte of 1.0."""
UNKNOWN = 255
"""The byte of NaN."""
AXIS_TOLERANCE = 0.002
"""Length of the difference of unit vectors, 0.1 degrees: more than half floats round normals and rotations by."""
_HALF_FIELDS = ("quat_wxyz", "scale_m", "opacity", "normal", "sh_rest", "falloff")
_BYTE_FIELDS = ("intensity", "ray_drop")


def archived(scene: GaussianScene) -> GaussianScene:
    """The scene as an archive keeps it; a scene read from an archive is returned with the same values."""
    dynamic = dataclasses.replace(scene.dynamic, gaussians=_rounded(scene.dynamic.gaussians))
    sky = half(scene.sky).astype(np.float32)
    return dataclasses.replace(scene, static=_rounded(scene.static), dynamic=dynamic, sky=sky)


def half(values: Float[np.ndarray, "*n"]) -> Float16[np.ndarray, "*n"]:
    """Nearest half floats; what exceeds their range becomes the largest finite one."""
    return np.clip(values, -LARGEST, LARGEST).astype(np.float16, order="C")


def byte_levels(values: Float32[np.ndarray, " n"]) -> UInt8[np.ndarray, " n"]:
    """Values of 0..1, or NaN, as bytes."""
    return np.where(np.isnan(values), UNKNOWN, np.rint(np.nan_to_num(values) * LEVELS)).astype(np.uint8)


def from_byte_levels(levels: UInt8[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    """Values of ``byte_levels``."""
    return np.where(levels == UNKNOWN, np.float32(np.nan), levels / np.float32(LEVELS)).astype(np.float32)


def third_axes(quat_wxyz: Float32[np.ndarray, "n 4"]) -> Float32[np.ndarray, "n 3"]:
    """The third axis of Gaussians, at the precision of half floats."""
    w, x, y, z = np.ascontiguousarray(quat_wxyz.T, np.float64)
    axes = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z], axis=-1)
    # What is read may be no rotation; the check of the scene will say so.
    return half(axes / np.maximum(w * w + x * x + y * y + z * z, 1e-12)[:, None]).astype(np.float32)


def constant_terms(rgb: Float32[np.ndarray, "n 3"]) -> Float16[np.ndarray, "n 3"]:
    """Spherical-harmonics terms of degree 0 of display colours."""
    return half(np.rint((rgb.astype(np.float64) - 0.5) / SH_C0 / TERM_STEP) * TERM_STEP)


def colours(terms: Float16[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Display colours of terms of degree 0."""
    return (0.5 + SH_C0 * terms.astype(np.float64)).astype(np.float32)


def _rounded(gaussians: Gaussians) -> Gaussians:
    given = {name: getattr(gaussians, name) for name in (*_HALF_FIELDS, *_BYTE_FIELDS)}
    fields = {
        name: half(values).astype(np.float32) if name in _HALF_FIELDS else from_byte_levels(byte_levels(values))
        for name, values in given.items()
        if values is not None
    }
    axes, normal = third_axes(fields["quat_wxyz"]), fields["normal"]
    of_disc = np.linalg.norm(axes - normal, axis=1, keepdims=True) < AXIS_TOLERANCE
    fields["normal"] = np.where(of_disc, axes, normal)
    return dataclasses.replace(gaussians, rgb=colours(constant_terms(gaussians.rgb)), **fields)
