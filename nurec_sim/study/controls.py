"""Reconstructions made worse on purpose: a study that ranks policies in them as well as in good ones shows nothing.

A control maps a scene to a scene that renders worse; facts (rig, actors, map) stay, so only the sensors differ.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from nurec_sim.types import DynamicGaussians, GaussianScene

KEPT_OF_SPARSE = 4
STRETCH = 1.05


def sparse(scene: GaussianScene) -> GaussianScene:
    """A quarter of the static Gaussians, every fourth one."""
    return dataclasses.replace(scene, static=scene.static[::KEPT_OF_SPARSE])


def faint(scene: GaussianScene) -> GaussianScene:
    """Half the opacity, of static and moving Gaussians."""
    moving = scene.dynamic.gaussians
    dynamic = dataclasses.replace(
        scene.dynamic, gaussians=dataclasses.replace(moving, opacity=moving.opacity * np.float32(0.5))
    )
    static = dataclasses.replace(scene.static, opacity=scene.static.opacity * np.float32(0.5))
    return dataclasses.replace(scene, static=static, dynamic=dynamic)


def empty_road(scene: GaussianScene) -> GaussianScene:
    """No moving Gaussians: actors are still there to be hit, but cannot be seen."""
    return dataclasses.replace(scene, dynamic=DynamicGaussians.empty())


def stretched(scene: GaussianScene) -> GaussianScene:
    """Static Gaussians 5 % farther from the nearest recorded position of the car: a wrong scale of depth."""
    driven = scene.ego.position_m
    nearest = driven[cKDTree(driven).query(scene.static.mean_m)[1]]
    mean = (nearest + STRETCH * (scene.static.mean_m - nearest)).astype(np.float32)
    return dataclasses.replace(scene, static=dataclasses.replace(scene.static, mean_m=mean))


def no_sky(scene: GaussianScene) -> GaussianScene:
    """A black sky."""
    return dataclasses.replace(scene, sky=np.zeros_like(scene.sky))


CONTROLS: dict[str, Callable[[GaussianScene], GaussianScene]] = {
    "sparse": sparse,
    "faint": faint,
    "empty_road": empty_road,
    "stretched": stretched,
    "no_sky": no_sky,
}
"""Controls by name."""
