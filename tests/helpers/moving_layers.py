"""Layers of moving Gaussians, and the packed one compared with the readable one field by field."""

import dataclasses

import numpy as np
from render_scenes import moving_cloud, track

from nurec_sim.render.cpu.moving import PackedMoving
from nurec_sim.render.cpu.pack import (
    COLOUR,
    DROP,
    FALLOFF,
    INTENSITY,
    KNOWN,
    LABEL,
    LOG_OPACITY,
    MAX_OPACITY,
    MEAN,
    NORMAL,
    QUAT,
    SCALE,
)
from nurec_sim.render.cpu.workers import Buffers, Workers
from nurec_sim.render.layers import moving_gaussians
from nurec_sim.types import DynamicGaussians, Gaussians

EYE = np.array([1.0, -2.0, 1.5])

TRACKS = [dataclasses.replace(track(), id=name) for name in ("near", "far", "empty")]


def layer(n=400, sh=0, seed=3):
    """Gaussians of two tracks and of none, with normals, in no particular order."""
    rng = np.random.default_rng(seed)
    parts = [moving_cloud(n, seed + k, track=k) for k in (-1, 0, 1)]
    order = rng.permutation(3 * n)
    gaussians = Gaussians.concatenate([part.gaussians for part in parts])[order]
    normal = rng.normal(size=(3 * n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[rng.random(3 * n) < 0.1] = 0
    rest = rng.normal(0, 0.3, (3 * n, sh, 3)).astype(np.float32) if sh else None
    drop = rng.random(3 * n).astype(np.float32)
    falloff = rng.random(3 * n).astype(np.float32)
    gaussians = dataclasses.replace(
        gaussians, normal=normal.astype(np.float32), sh_rest=rest, ray_drop=drop, falloff=falloff
    )
    knot_t_us, knot_m, owner = (
        np.concatenate([getattr(part, name) for part in parts])[order] for name in ("knot_t_us", "knot_m", "track")
    )
    return DynamicGaussians(gaussians, knot_t_us, knot_m, owner)


def placed(dynamic, t_us, actors, threads=2):
    """The packed layer at an instant, its arrays copied."""
    with Buffers().lend() as array:
        result = PackedMoving.of(dynamic, TRACKS).at(t_us, actors, frozenset(), EYE, Workers(threads), array)
        return dataclasses.replace(result, fields=result.fields.copy())


def alive_rows(packed):
    """Rows of the layer that are alive, and their fields [n,21]."""
    fields = packed.fields.transpose(0, 2, 1).reshape(-1, packed.fields.shape[1])
    alive = np.flatnonzero(fields[:, LOG_OPACITY] > -1e8)
    order = np.argsort(packed.index[alive])
    return packed.index[alive][order], fields[alive][order]


def expected(dynamic, t_us, actors):
    """What the readable layer gives, and the rows of those that it keeps."""
    numbered = dataclasses.replace(
        dynamic,
        gaussians=dataclasses.replace(dynamic.gaussians, intensity=np.arange(len(dynamic), dtype=np.float32)),
    )
    result = moving_gaussians(numbered, TRACKS, t_us, actors, EYE)
    rows = result.intensity.astype(int)
    return rows, dataclasses.replace(result, intensity=dynamic.gaussians.intensity[rows])


def assert_packed_is_readable(dynamic, t_us, actors=None):
    """Compare every field of every Gaussian; returns how many are alive."""
    actors = actors or {}
    rows, fields = alive_rows(placed(dynamic, t_us, actors))
    wanted_rows, wanted = expected(dynamic, t_us, actors)
    assert np.array_equal(rows, wanted_rows)
    quat = wanted.quat_wxyz / np.linalg.norm(wanted.quat_wxyz, axis=1, keepdims=True)
    drop = np.zeros(len(rows)) if wanted.ray_drop is None else wanted.ray_drop
    falloff = np.zeros(len(rows)) if wanted.falloff is None else wanted.falloff * wanted.normal.any(axis=1)
    for first, values in (
        (MEAN, wanted.mean_m),
        (SCALE, wanted.scale_m),
        (QUAT, quat),
        (COLOUR, wanted.rgb),
        (NORMAL, wanted.normal),
        (LABEL, wanted.label[:, None]),
        (DROP, drop[:, None]),
        (FALLOFF, falloff[:, None]),
        (INTENSITY, np.nan_to_num(wanted.intensity)[:, None]),
        (KNOWN, np.isfinite(wanted.intensity)[:, None]),
    ):
        got = fields[:, first : first + values.shape[1]]
        assert np.abs(got - values).max(initial=0) <= 1e-5, first
    opacity = np.exp(fields[:, LOG_OPACITY].astype(np.float64))
    assert np.abs(opacity - np.minimum(wanted.opacity, MAX_OPACITY)).max(initial=0) <= 1e-5
    return len(rows)
