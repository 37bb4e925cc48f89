"""Actors of the towns as Gaussians: samples of their meshes, with the colours and the reflectivity of their materials.

Nothing here needs MuJoCo or OpenGL. Light is that of an overcast sky, since the light of a log is not known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.types import Gaussians, Label
from nurec_sim.world.assets import people, textures_ground, textures_people, textures_vehicles
from nurec_sim.world.assets.meshes import Corners, MeshBuilder
from nurec_sim.world.assets.vehicle_families import FAMILIES
from nurec_sim.world.assets.vehicle_meshes import LASER_OF_PART, vehicle_parts
from nurec_sim.world.plan.fleet import SIZE_OF_KIND_M
from nurec_sim.world.plan.pedestrians import SIZE_M
from nurec_sim.world.plan.surface import REFLECTIVITY, SurfaceClass

Size = tuple[float, float, float]
Colour = tuple[float, float, float]

ACTOR_SIZES_M: dict[str, Size] = {**SIZE_OF_KIND_M, "pedestrian": SIZE_M}
"""Usual sizes of all kinds of actors."""
SPACING_SHARE, SPACING_M = 0.012, (0.02, 0.08)
"""Distance between Gaussians: this share of the longest side, within these limits (m)."""
SIGMA, THICK = 0.6, 0.1
"""Standard deviations along the surface and across it, in spacings: neighbours close the gaps between them."""
OPACITY = 0.95
SAMPLES = 12
"""Samples of the mesh per Gaussian, whose texture is averaged."""
AMBIENT = 0.68
"""Light on faces that look down; those that look up get 1."""
SHADOW_STEP_M, SHADOW_ABOVE_M = 0.12, 0.015
STRIDE, PHASE_RAD = 0.8, 0.6
"""Pose of a person: they keep it while they move."""


@dataclass(frozen=True)
class _Surface:
    """A part: triangle corners in the box frame, its texture or colour, and the share of light that it reflects."""

    corners: Corners
    image: np.ndarray
    tint: Colour
    laser: float


def actor_gaussians(kind: str, size_m: Size, colour: Colour, coarser: float = 1.0) -> Gaussians:
    """The Gaussians of an actor in its box frame: x forward, y left, z up, origin at the centre of the box.

    Args:
        kind: one of ``ACTOR_SIZES_M``.
        size_m: length, width and height of its box; vehicles fill it.
        colour: of paint or shirt, 0..1.
        coarser: Gaussians are so many times as far apart as usual, and as wide.

    Raises:
        ValueError: no such kind.
    """
    # Of textures, hair and clothes.
    rng = np.random.default_rng([0, *kind.encode()])
    person = kind in ("pedestrian", "cyclist")
    surfaces = _person(rng, kind, size_m, colour) if person else _vehicle(rng, kind, size_m, colour)
    spacing = coarser * float(np.clip(SPACING_SHARE * max(size_m), *SPACING_M))
    parts = [_sampled(surface, spacing) for surface in surfaces]
    footprint = (1.5 if kind == "cyclist" else 0.45, 0.4) if person else size_m[:2]
    return Gaussians.concatenate([*parts, _shadow(*footprint, size_m[2])])


def _vehicle(rng: np.random.Generator, kind: str, size_m: Size, colour: Colour) -> Iterator[_Surface]:
    plain = REFLECTIVITY[SurfaceClass.VEHICLE]
    parts = vehicle_parts(kind, size_m)
    images = {
        "paint": textures_vehicles.body_atlas(rng, FAMILIES[kind], size_m),
        "glass": textures_vehicles.window(rng),
        "wheel": textures_vehicles.wheel(rng),
        "headlight": textures_vehicles.lamp(rng, (214, 220, 224)),
        "taillight": textures_vehicles.lamp(rng, (196, 18, 20)),
        "plate": textures_vehicles.plate(rng),
        "cargo": textures_vehicles.cargo_box(rng),
    }
    for name, mesh in parts.items():
        tint = colour if name == "paint" else (1.0, 1.0, 1.0)
        yield _Surface(mesh.corners(34.0), images[name], tint, LASER_OF_PART.get(name, plain))


def _person(rng: np.random.Generator, kind: str, size_m: Size, shirt: Colour) -> Iterator[_Surface]:
    """Trunk and limbs in one pose, and a bicycle below a cyclist; scaled to the height of the box."""
    rides = kind == "cyclist"
    lean = people.LEAN_RAD if rides else 0.0
    body = MeshBuilder()
    body.extend(people.trunk(rng, helmet=rides, lean_rad=lean))
    angles = people.cycling_angles(PHASE_RAD) if rides else people.walking_angles(PHASE_RAD, STRIDE)
    frames = {"": np.eye(4)}
    for limb in people.LIMBS:
        c, s = np.cos(angles[limb.name]), np.sin(angles[limb.name])
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        joint = np.array(people.leaning_joint(limb, lean))
        frames[limb.name] = frames[limb.parent] @ geometry.pose(turn, joint)
        body.extend(people.limb(limb.name), frames[limb.name])
    scale = size_m[2] / people.HEIGHT_M
    laser = REFLECTIVITY[SurfaceClass.CYCLIST if rides else SurfaceClass.PERSON]
    foot = np.array([0.0, 0.0, -size_m[2] / 2])

    def placed(mesh: MeshBuilder, at: tuple[float, float, float]) -> Corners:
        points, normals, uv = mesh.corners(70.0)
        return (points + at) * scale + foot, normals, uv

    seat = (-0.2, 0.0, 0.02) if rides else (0.0, 0.0, 0.0)
    yield _Surface(placed(body, seat), textures_people.person(rng, shirt), (1.0, 1.0, 1.0), laser)
    if rides:
        white = np.full((1, 1, 3), 255, np.uint8)
        tints = {"frame": tuple(float(c) for c in rng.uniform(0.08, 0.85, 3)), "tyres": (0.075, 0.075, 0.08)}
        for name, mesh in people.bicycle().items():
            yield _Surface(placed(mesh, (0.0, 0.0, 0.0)), white, tints[name], laser)  # type: ignore[arg-type]


def _sampled(surface: _Surface, spacing_m: float) -> Gaussians:
    """One Gaussian per cube of side ``spacing_m`` and direction of the surface, at the mean of its samples."""
    place, normal, uv = (values.reshape(-1, 3, values.shape[1]) for values in surface.corners)
    area = np.linalg.norm(np.cross(place[:, 1] - place[:, 0], place[:, 2] - place[:, 0]), axis=1) / 2
    count = max(SAMPLES, int(np.ceil(area.sum() * SAMPLES / spacing_m**2)))
    # Even in area from triangle to triangle, and within one by the R2 sequence (Roberts 2018), folded into it.
    at = (np.arange(count) + 0.5) / count * area.sum()
    triangle = np.minimum(np.searchsorted(np.cumsum(area), at), len(area) - 1)
    a, b = np.modf(np.arange(count)[:, None] * np.array([0.7548776662466927, 0.5698402909980532]))[0].T
    folded = a + b > 1
    a, b = np.where(folded, 1 - a, a), np.where(folded, 1 - b, b)
    weight = np.stack([1 - a - b, a, b], axis=1)[:, :, None]
    point, facing, texel = ((weight * values[triangle]).sum(axis=1) for values in (place, normal, uv))
    rgb = _texture(surface.image, texel) * np.asarray(surface.tint)

    cube = np.floor((point - point.min(axis=0)) / spacing_m).astype(np.int64)
    strongest = np.abs(facing).argmax(axis=1)
    side = 2 * strongest + (facing[np.arange(count), strongest] > 0)
    _, group = np.unique(np.ravel_multi_index((*cube.T, side), (*(cube.max(axis=0) + 1), 6)), return_inverse=True)
    share = 1.0 / np.bincount(group)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(group, column) * share for column in values.T], axis=1)

    up = mean(facing)
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
    light = AMBIENT + (1 - AMBIENT) * (up[:, 2:] + 1) / 2
    sigma = spacing_m * np.array([SIGMA, SIGMA, THICK])
    return _discs(mean(point), up, sigma, mean(rgb) * light, np.full(len(up), OPACITY), Label.MOVABLE, surface.laser)


def _texture(image: np.ndarray, uv: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    """Colours 0..1 at texture coordinates; the image repeats, and v runs upwards."""
    height, width = image.shape[:2]
    column = np.floor(np.mod(uv[:, 0], 1.0) * width).astype(np.int64) % width
    row = np.floor(np.mod(1 - uv[:, 1], 1.0) * height).astype(np.int64) % height
    return image[row, column, :3] / 255.0


def _shadow(length_m: float, width_m: float, height_m: float) -> Gaussians:
    """The dark ground below an actor, as in the towns (``textures_ground.contact_shadow``)."""
    steps = [max(4, round((side + 1.0) / SHADOW_STEP_M)) for side in (length_m, width_m)]
    cover = textures_ground.contact_shadow(length_m, width_m)[..., 3] / 255.0
    x, y = np.meshgrid(*((np.arange(n) + 0.5) / n for n in steps), indexing="ij")
    opacity = cover[(x * cover.shape[0]).astype(int), (y * cover.shape[1]).astype(int)].ravel()
    place = np.column_stack([(x.ravel() - 0.5) * (length_m + 1.0), (y.ravel() - 0.5) * (width_m + 1.0),
                             np.full(x.size, SHADOW_ABOVE_M - height_m / 2)])[opacity > 0.02]  # fmt: skip
    opacity = opacity[opacity > 0.02]
    sigma = SHADOW_STEP_M * np.array([SIGMA, SIGMA, 0.02])
    up = np.tile([0.0, 0.0, 1.0], (len(place), 1))
    return _discs(place, up, sigma, np.full_like(place, 0.03), opacity, Label.ROAD, REFLECTIVITY[SurfaceClass.ROAD])


def _discs(
    place: Float64[np.ndarray, "n 3"], normal: Float64[np.ndarray, "n 3"], sigma_m: Float64[np.ndarray, " 3"],
    rgb: Float64[np.ndarray, "n 3"], opacity: Float64[np.ndarray, " n"], label: Label, laser: float,
) -> Gaussians:  # fmt: skip
    """Flat Gaussians whose third axis is the normal."""
    count = len(place)
    across = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(across, normal)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    turn = np.stack([first, np.cross(normal, first), normal], axis=2)

    def single(values: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(values, np.float32)

    return Gaussians(
        single(place), single(geometry.quat_from_matrix(turn)), single(np.tile(sigma_m, (count, 1))), single(opacity),
        single(np.clip(rgb, 0, 1)), single(normal), np.full(count, label, np.uint8),
        np.full(count, laser, np.float32),
    )  # fmt: skip
