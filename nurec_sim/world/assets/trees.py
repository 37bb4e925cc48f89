"""Meshes of trees, bushes and hedges: a rough core inside a shell of leaf clusters, all on one texture.

Origin on the ground below the trunk. Normals point away from the crown's centre for soft shading.
"""

from __future__ import annotations

import numpy as np

from nurec_sim.world.assets.meshes import MeshBuilder, icosphere
from nurec_sim.world.assets.textures_plants import BARK_SHARE

LEAF_TILE_M = 2.2


def tree(rng: np.random.Generator, family: str, scale: float) -> MeshBuilder:
    """A tree whose lowest branches leave 2.2 m free, about 7 m high at ``scale`` 1; conifers reach lower."""
    if family == "conifer":
        return _conifer(rng, scale)
    mesh = MeshBuilder()
    slim = family == "birch"
    bottom = 2.3 + float(rng.uniform(0.0, 0.5))
    wide, tall = ((1.15, 2.3) if slim else (1.75, 1.75)) * np.array(scale)
    tall *= float(rng.uniform(0.9, 1.15))
    middle = np.array([0.0, 0.0, bottom + tall * 0.92])
    _trunk(mesh, rng, middle[2], (0.11 if slim else 0.17) * scale)
    lobes = 5 if slim else 6
    # Lobes on an ellipsoid around the middle of the crown, evenly in angle.
    for i in range(lobes):
        angle, level = 2 * np.pi * (i + rng.random() * 0.5) / lobes, float(rng.uniform(-0.45, 0.45))
        reach = wide * (0.52 if slim else 0.56) * float(np.sqrt(1 - level**2))
        centre = middle + [reach * np.cos(angle), reach * np.sin(angle), level * tall * (0.95 if slim else 0.8)]
        _lobe(mesh, rng, centre, np.array([0.62, 0.62, 0.60]) * wide * float(rng.uniform(0.85, 1.1)), middle, 42)
    _lobe(mesh, rng, middle + [0, 0, 0.48 * tall], np.array([0.62, 0.62, 0.5]) * wide, middle, 34)
    return mesh


def bush(rng: np.random.Generator, scale: float) -> MeshBuilder:
    """A bush about 1.1 m high at ``scale`` 1."""
    mesh, middle = MeshBuilder(), np.array([0.0, 0.0, 0.45]) * scale
    for x in (-0.45, 0.05, 0.5):
        centre = np.array([x, float(rng.normal(0, 0.12)), float(rng.uniform(0.38, 0.5))]) * scale
        _lobe(mesh, rng, centre, np.array([0.5, 0.5, 0.45]) * scale * float(rng.uniform(0.85, 1.15)), middle, 26)
    return mesh


def hedge(rng: np.random.Generator, length_m: float, height_m: float) -> MeshBuilder:
    """A clipped hedge along y."""
    mesh, half = MeshBuilder(), 0.34
    count = max(2, round(length_m / 0.5))
    y = np.linspace(-length_m / 2, length_m / 2, count + 1)
    outline = [(half, -0.2), (half, height_m * 0.5), (half * 0.92, height_m), (-half * 0.92, height_m),
               (-half, height_m * 0.5), (-half, -0.2)]  # fmt: skip
    lattice = np.array([[(x, s, z) for x, z in outline] for s in y])
    lattice[:, 1:-1] += rng.normal(0, 0.045, (count + 1, len(outline) - 2, 3)) * [1, 0.3, 1]
    around = np.array([0.0, 0.45, 0.95, 1.55, 2.05, 2.5])
    uv = np.stack(np.meshgrid(y, around * height_m, indexing="ij"), axis=-1) / LEAF_TILE_M
    mesh.grid(lattice[:, ::-1], _in_leaves(uv[:, ::-1]))
    for end, order in ((0, -1), (-1, 1)):
        ring = lattice[end]
        uv_end = _in_leaves(ring[:, [0, 2]] / LEAF_TILE_M)
        mesh.add(ring, [[0, i, i + 1][::-order] for i in range(1, len(ring) - 1)], uv_end)
    return mesh


def _conifer(rng: np.random.Generator, scale: float) -> MeshBuilder:
    """Tiers of drooping branches around a stem."""
    mesh = MeshBuilder()
    high, wide = 7.6 * scale * float(rng.uniform(0.9, 1.15)), 1.75 * scale
    _trunk(mesh, rng, high * 0.8, 0.13 * scale)
    tiers, low = 9, 1.0
    sides = 11
    for tier in range(tiers):
        share = tier / (tiers - 1)
        z = low + (high - low) * 0.90 * share
        radius = wide * (1 - share) ** 0.85 + 0.12
        drop = (high - low) / tiers * 1.5
        angle = np.linspace(0, 2 * np.pi, 2 * sides + 1) + float(rng.uniform(0, 1))
        # Zigzag outline of branches.
        out = radius * np.where(np.arange(2 * sides + 1) % 2, 1.0, 0.62) * (1 + 0.12 * rng.normal(size=2 * sides + 1))
        out[-1] = out[0]
        ring = np.stack([out * np.cos(angle), out * np.sin(angle), z - 0.35 * drop * (out / radius)], axis=1)
        top = np.stack([0.08 * np.cos(angle), 0.08 * np.sin(angle), np.full(len(angle), z + drop * 0.8)], axis=1)
        lattice = np.stack([ring, top], axis=1)
        uv = np.stack(
            [
                np.stack([angle * radius, np.zeros_like(angle)], 1),
                np.stack([angle * radius, np.full_like(angle, radius)], 1),
            ],
            axis=1,
        )
        mesh.grid(lattice, _in_leaves(uv / LEAF_TILE_M))
        below = np.concatenate([ring[:-1], [[0.0, 0.0, z + 0.1 * drop]]])
        fan = [[(i + 1) % (2 * sides), i, 2 * sides] for i in range(2 * sides)]
        mesh.add(below, fan, _in_leaves(below[:, :2] / LEAF_TILE_M))
    return mesh


def _trunk(mesh: MeshBuilder, rng: np.random.Generator, high: float, radius: float) -> None:
    sides, angle = 7, np.linspace(0, 2 * np.pi, 8)
    bend = rng.normal(0, 0.06, (3, 2))
    rings = [(-0.4, radius * 1.5), (0.35, radius), (high * 0.55, radius * 0.8), (high, radius * 0.45)]
    lattice = np.array([[(r * np.cos(a) + bend[min(k, 2), 0] * (k > 1), r * np.sin(a) + bend[min(k, 2), 1] * (k > 1), z)
                         for k, (z, r) in enumerate(rings)] for a in angle])  # fmt: skip
    u, v = np.meshgrid(np.linspace(0, 1, sides + 1), np.linspace(0.04, 0.9, len(rings)) * BARK_SHARE, indexing="ij")
    mesh.grid(lattice, np.stack([u, v], axis=-1))


def _lobe(mesh: MeshBuilder, rng: np.random.Generator, centre: np.ndarray, half: np.ndarray, crown: np.ndarray,
          clusters: int) -> None:  # fmt: skip
    """A core, and ragged clusters of leaves that stick out of it in all directions."""
    points, faces = icosphere(1)
    lumps = 1 + 0.10 * rng.normal(size=len(points))
    core = points * half * 0.90 * lumps[:, None] + centre
    uv = np.stack([np.arctan2(points[:, 1], points[:, 0]) * half[0], points[:, 2] * half[2]], axis=1) / LEAF_TILE_M
    mesh.add(core, faces, _in_leaves(uv + rng.random(2)), _soft(core, points, crown))
    # Normalised Gaussian vectors are uniform on the sphere.
    out = rng.normal(size=(clusters, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    # Clusters lie roughly tangential to the crown, with random tilt.
    side = np.cross(out + 0.35 * rng.normal(size=out.shape), rng.normal(size=out.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    lift = np.cross(out, side)
    place = out * half * rng.uniform(0.92, 1.06, (clusters, 1)) + centre
    size = 0.34 * float(half.mean()) * rng.uniform(0.7, 1.3, (clusters, 1, 1))
    corners = np.array([[-1.0, -0.3], [-0.15, -0.75], [0.9, -0.5], [0.55, 0.35], [0.1, 1.0], [-0.6, 0.6]])
    shape = corners[None] * rng.uniform(0.6, 1.35, (clusters, len(corners), 1)) * size
    tilt = rng.normal(0, 0.35, (clusters, len(corners), 1)) * size
    patch = place[:, None] + shape[..., :1] * side[:, None] + shape[..., 1:] * lift[:, None] + tilt * out[:, None]
    fan = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    index = np.arange(clusters)[:, None, None] * len(corners) + fan
    flat = patch.reshape(-1, 3)
    uv = (shape / LEAF_TILE_M + rng.random((clusters, 1, 2))).reshape(-1, 2)
    normals = _soft(flat, np.repeat(out, len(corners), axis=0), crown)
    mesh.add(flat, index.reshape(-1, 3), _in_leaves(uv), normals)


def _soft(points: np.ndarray, outward: np.ndarray, crown: np.ndarray) -> np.ndarray:
    """Normals between those of a lobe and those of the whole crown."""
    away = points - crown
    away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
    # Mostly the crown's own shape, brighter from above, as light scatters within it.
    normals = 0.55 * outward + 0.6 * away + [0, 0, 0.12]
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _in_leaves(uv: np.ndarray) -> np.ndarray:
    """Texture coordinates mirrored into the leaf part, because the bark is below it."""
    v = np.abs(np.mod(uv[..., 1], 2.0) - 1.0)
    return np.stack([uv[..., 0], BARK_SHARE + 0.015 + v * (1 - BARK_SHARE - 0.03)], axis=-1)
