"""What the renderer precomputes for a sensor, and the cache that keeps it between frames."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np
from jaxtyping import Float32, Int64

from nurec_sim.render.cpu.blend.rays import RayTiles, tile_rays
from nurec_sim.render.cpu.grid import Grid, grid_key, make_grid
from nurec_sim.render.lod import ray_spacing
from nurec_sim.types import CameraModel, LidarModel

KEPT_RAYS = 50_000_000
"""Rays of all sensors in a cache, at most, unless there is only one; some 60 bytes each."""


@dataclass(frozen=True, eq=False)
class SensorTables:
    """Tables of a sensor, each computed on first use: a static pinhole needs few of them."""

    grid: Grid

    @property
    def rays(self) -> RayTiles:
        """The rays as the blending kernels read them."""
        # Before Python 3.12 ``cached_property`` holds a lock of all instances while it computes. ``tile_rays`` lets
        # other jobs of a server run meanwhile; one that needs this lock would never let it run again.
        kept = vars(self)
        if "_rays" not in kept:
            kept["_rays"] = tile_rays(self.grid)
        return kept["_rays"]

    @cached_property
    def ray_z(self) -> Float32[np.ndarray, "h w"]:
        """Depth per distance: the z of the unit rays."""
        return np.ascontiguousarray(self.grid.direction[..., 2])

    @cached_property
    def spacing_rad(self) -> float:
        """The usual angle between neighbouring rays."""
        return ray_spacing(self.grid.direction)

    @cached_property
    def all_valid(self) -> bool:
        """Whether every pixel has a ray."""
        return bool(np.all(self.grid.valid))

    @cached_property
    def cell_of_beam(self) -> Int64[np.ndarray, " n"]:
        """Flat grid index of each beam of a LiDAR."""
        assert self.grid.beam is not None
        return np.argsort(self.grid.beam.reshape(-1))


class _Tables(Protocol):
    @property
    def grid(self) -> Grid: ...


T = TypeVar("T", bound=_Tables)


class SensorCache(Generic[T]):
    """Tables of the sensors that were used last, up to ``KEPT_RAYS`` rays; safe to use from many threads.

    Args:
        make: tables of a grid.
    """

    def __init__(self, make: Callable[[Grid], T]) -> None:
        self._make = make
        self._kept: OrderedDict[tuple, T] = OrderedDict()
        self._lock = threading.Lock()

    def tables(self, model: CameraModel | LidarModel) -> T:
        """Tables of a sensor; models that differ only in their mount or their id share them."""
        key = grid_key(model)
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        made = self._make(make_grid(model))  # outside the lock: it takes up to some hundred milliseconds
        with self._lock:
            self._kept[key] = made
            while len(self._kept) > 1 and sum(each.grid.valid.size for each in self._kept.values()) > KEPT_RAYS:
                self._kept.popitem(last=False)
        return made
