"""Packed blocks hold every Gaussian once, however many parts they are packed in."""

import numpy as np
import pytest

from nurec_sim.render.cpu import pack as packing
from nurec_sim.render.cpu.pack import BLOCK, COLOUR, LABEL, LOG_OPACITY, MEAN, NEVER_SEEN, SCALE, pack
from nurec_sim.types import Gaussians


def cloud(count):
    rng = np.random.default_rng(5)
    one = Gaussians.empty(count)
    one.mean_m[:], one.scale_m[:], one.rgb[:] = rng.normal(size=(3, count, 3))
    np.abs(one.scale_m, out=one.scale_m)
    one.opacity[:], one.label[:] = rng.uniform(0.1, 0.9, count), rng.integers(0, 3, count)
    one.opacity[::7] = 0.001
    return one


@pytest.mark.parametrize("part", [1, 2, 64])
def test_every_gaussian_that_can_be_seen_is_in_one_place(monkeypatch, part):
    monkeypatch.setattr(packing, "PART", part)
    gaussians = cloud(4 * BLOCK + 100)
    packed = pack(gaussians)
    rows = np.flatnonzero(packed.index >= 0)
    seen = np.flatnonzero(gaussians.opacity >= 1 / 255)
    assert np.array_equal(np.sort(packed.index[rows]), seen)
    fields, of = packed.fields.transpose(0, 2, 1).reshape(len(packed) * BLOCK, -1), packed.index[rows]
    assert np.array_equal(fields[rows, MEAN : MEAN + 3], gaussians.mean_m[of])
    assert np.array_equal(fields[rows, SCALE : SCALE + 3], gaussians.scale_m[of])
    assert np.array_equal(fields[rows, COLOUR : COLOUR + 3], gaussians.rgb[of])
    assert np.array_equal(fields[rows, LABEL], gaussians.label[of])
    assert (np.delete(fields, rows, axis=0)[:, LOG_OPACITY] == np.float32(NEVER_SEEN)).all()
    for block, (centre, radius) in enumerate(zip(packed.block_centre, packed.block_radius, strict=True)):
        mine = packed.index[block * BLOCK : (block + 1) * BLOCK]
        assert (np.linalg.norm(gaussians.mean_m[mine[mine >= 0]] - centre, axis=1) < radius).all()


def test_parts_change_no_byte(monkeypatch):
    gaussians = cloud(5 * BLOCK + 1)
    whole = pack(gaussians)
    monkeypatch.setattr(packing, "PART", 1)
    parts = pack(gaussians)
    for name in ("fields", "index", "block_centre", "block_radius"):
        assert np.array_equal(getattr(parts, name), getattr(whole, name))
