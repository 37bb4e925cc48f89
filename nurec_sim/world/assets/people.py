"""Meshes of people: rigid parts in the frames of their joints, textured with the bands of ``textures_people``.

Body frame: x forward, y left, z up, origin on the ground, for a person of 1.76 m; limbs hang down from their joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nurec_sim.world.assets.meshes import MeshBuilder, icosphere
from nurec_sim.world.assets.textures_people import band_uv

HEIGHT_M = 1.76
HIP_M, KNEE_M, SHOULDER_M, ELBOW_M = 0.92, 0.46, 1.44, 0.29
"""Heights of hip and shoulder; lengths of thigh and upper arm."""
LEAN_RAD = 0.55
"""Forward lean of cyclists."""


@dataclass(frozen=True)
class Limb:
    """A part that turns about the y axis at a joint; ``parent`` is another limb or empty for the trunk."""

    name: str
    parent: str
    joint: tuple[float, float, float]


LIMBS = tuple(
    limb
    for side, y in (("left", 1), ("right", -1))
    for limb in (
        Limb(f"{side}_thigh", "", (0.0, y * 0.10, HIP_M)),
        Limb(f"{side}_shin", f"{side}_thigh", (0.0, 0.0, -KNEE_M)),
        Limb(f"{side}_arm", "", (0.0, y * 0.20, SHOULDER_M)),
        Limb(f"{side}_forearm", f"{side}_arm", (0.0, y * 0.015, -ELBOW_M)),
    )
)


def leaning_joint(limb: Limb, lean_rad: float) -> tuple[float, float, float]:
    """A limb's joint in its parent's frame; shoulders move with the trunk, which leans forward about the hip."""
    x, y, z = limb.joint
    if limb.parent or not limb.name.endswith("_arm"):
        return x, y, z
    up = z - HIP_M
    return up * float(np.sin(lean_rad)), y, HIP_M + up * float(np.cos(lean_rad))


def walking_angles(phase_rad: float, stride: float) -> dict[str, float]:
    """Joint angles (rad, positive swings backwards) of a walker; ``stride`` 0 is standing, 1 a brisk walk."""
    angles = {}
    for side, shift in (("left", 0.0), ("right", np.pi)):
        swing = np.sin(phase_rad + shift)
        angles[f"{side}_thigh"] = -0.50 * stride * swing - 0.03
        # Knees only bend backwards, and most while the thigh swings forward through the middle.
        angles[f"{side}_shin"] = stride * (0.14 + 0.55 * max(0.0, np.cos(phase_rad + shift)) ** 1.5)
        # Arms swing against the leg of their side.
        angles[f"{side}_arm"] = 0.42 * stride * swing + 0.02
        angles[f"{side}_forearm"] = -0.20 - 0.25 * stride
    return angles


def cycling_angles(phase_rad: float) -> dict[str, float]:
    """Joint angles of a cyclist."""
    angles = {}
    for side, shift in (("left", 0.0), ("right", np.pi)):
        angles[f"{side}_thigh"] = -1.05 - 0.36 * np.sin(phase_rad + shift)
        angles[f"{side}_shin"] = 1.22 + 0.34 * np.sin(phase_rad + shift + 0.5)
        angles[f"{side}_arm"] = -1.02
        angles[f"{side}_forearm"] = -0.22
    return angles


def trunk(rng: np.random.Generator, *, helmet: bool = False, skirt: bool = False, lean_rad: float = 0.0) -> MeshBuilder:
    """Torso, neck and head, leaning forward about the hip; some people carry a backpack.

    Args:
        rng: random generator for build, hair and backpack.
        helmet: a helmet instead of hair.
        skirt: a skirt in the colour of the trousers.
        lean_rad: forward lean about the y axis at hip height.
    """
    mesh = MeshBuilder()
    rings = [(0.80, 0.095, 0.13), (0.90, 0.112, 0.162), (0.98, 0.112, 0.158), (1.10, 0.108, 0.150),
             (1.24, 0.118, 0.175), (1.36, 0.116, 0.190), (1.44, 0.098, 0.188), (1.49, 0.07, 0.11)]  # fmt: skip
    broad = float(rng.uniform(0.92, 1.15))
    if skirt:
        _tube(mesh, [(0.50, 0.20, 0.23), (0.72, 0.16, 0.20), (0.96, 0.116, 0.165)], "trousers", broad)
    _tube(mesh, rings[:3], "trousers", broad)
    _tube(mesh, [(0.955, 0.118, 0.164), *rings[3:]], "shirt", broad)
    _tube(mesh, [(1.47, 0.052, 0.056), (1.56, 0.050, 0.053)], "skin")
    _ball(mesh, (0.015, 0.0, 1.635), (0.098, 0.078, 0.122), "skin")
    _ball(mesh, (0.095, 0.0, 1.62), (0.022, 0.016, 0.024), "skin")  # nose
    if helmet:
        _ball(mesh, (0.005, 0.0, 1.70), (0.135, 0.10, 0.082), "shirt")
    else:
        _ball(mesh, (-0.018, 0.0, 1.668), (0.103, 0.088, 0.102), "hair")
        if rng.random() < 0.4:
            _ball(mesh, (-0.065, 0.0, 1.57), (0.055, 0.085, 0.16), "hair")
    if rng.random() < 0.35:
        _ball(mesh, (-0.19, 0.0, 1.24), (0.10, 0.15, 0.21), "shoes")
    if lean_rad:
        cos, sin = np.cos(lean_rad), np.sin(lean_rad)
        turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        mesh.warp(lambda points: (points - [0, 0, HIP_M]) @ turn.T + [0, 0, HIP_M])
    return mesh


def limb(name: str, *, bare: bool = False) -> MeshBuilder:
    """One limb in the frame of its joint."""
    mesh = MeshBuilder()
    kind = name.split("_")[1]
    if kind == "thigh":
        _tube(mesh, [(-KNEE_M, 0.058, 0.056), (-0.25, 0.078, 0.072), (0.02, 0.092, 0.086)], "trousers")
    elif kind == "shin":
        _tube(
            mesh, [(-0.40, 0.040, 0.040), (-0.20, 0.058, 0.054), (0.02, 0.058, 0.055)], "skin" if bare else "trousers"
        )
        _ball(mesh, (0.055, 0.0, -0.415), (0.135, 0.046, 0.045), "shoes")
    elif kind == "arm":
        _tube(mesh, [(-ELBOW_M - 0.02, 0.041, 0.041), (-0.1, 0.052, 0.050), (0.02, 0.056, 0.052)], "shirt")
        _ball(mesh, (0.0, 0.0, 0.005), (0.062, 0.058, 0.058), "shirt")
    else:
        _tube(mesh, [(-0.24, 0.030, 0.030), (-0.1, 0.038, 0.037), (0.015, 0.042, 0.041)], "skin" if bare else "shirt")
        _ball(mesh, (0.005, 0.0, -0.29), (0.035, 0.024, 0.062), "skin")
    return mesh


def bicycle() -> dict[str, MeshBuilder]:
    """Frame and tyres, in the rider's body frame with the saddle below the hip; the wheels touch z = 0."""
    frame, tyres = MeshBuilder(), MeshBuilder()
    rear, front, pedal, seat, head = (
        (-0.44, 0, 0.34),
        (0.60, 0, 0.34),
        (0.0, 0, 0.30),
        (-0.16, 0, 0.88),
        (0.46, 0, 0.86),
    )
    for a, b, radius in ((rear, pedal, 0.016), (rear, seat, 0.014), (pedal, seat, 0.019), (pedal, head, 0.022),
                         (seat, head, 0.019), (head, front, 0.018)):  # fmt: skip
        frame.cylinder(a, b, radius, sides=6, capped=False)
    frame.cylinder((0.40, -0.27, 0.99), (0.40, 0.27, 0.99), 0.014, sides=6)
    frame.cylinder(head, (0.41, 0, 0.99), 0.016, sides=6)
    frame.box((-0.20, 0, 0.91), (0.13, 0.07, 0.028))
    for hub in (rear, front):
        angle = np.linspace(0, 2 * np.pi, 25)
        tube = np.linspace(0, 2 * np.pi, 7)
        reach_m = 0.315 + 0.024 * np.cos(tube)
        ring = np.stack([hub[0] + np.outer(np.cos(angle), reach_m), np.tile(0.022 * np.sin(tube), (25, 1)),
                         hub[2] + np.outer(np.sin(angle), reach_m)], axis=2)  # fmt: skip
        tyres.grid(ring)
        for spoke in np.arange(4) * np.pi / 4:
            reach = 0.30 * np.array([np.cos(spoke), 0, np.sin(spoke)])
            tyres.cylinder(np.array(hub) - reach, np.array(hub) + reach, 0.004, sides=4, capped=False)
    return {"frame": frame, "tyres": tyres}


def _tube(mesh: MeshBuilder, rings: list[tuple[float, float, float]], band: str, wide: float = 1.0) -> None:
    """Ellipses (z, half depth, half width) joined upwards and closed at both ends; u = 0.5 is in front."""
    angle = np.linspace(-np.pi, np.pi, 11)
    lattice = np.array([[(a * np.cos(t), wide * b * np.sin(t), z) for z, a, b in rings] for t in angle])
    u, v = np.meshgrid(np.linspace(0, 1, len(angle)), np.linspace(0, 1, len(rings)), indexing="ij")
    mesh.grid(lattice, band_uv(band, u, v))
    for ring, order in ((lattice[:-1, 0], -1), (lattice[:-1, -1], 1)):
        count = len(ring)
        fan = [[0, i, i + 1][::order] for i in range(1, count - 1)]
        mesh.add(ring, fan, band_uv(band, np.full(count, 0.25), np.full(count, 0.5)))


def _ball(mesh: MeshBuilder, center: tuple[float, float, float], half: tuple[float, float, float], band: str) -> None:
    points, faces = icosphere(1)
    mesh.add(points * half + center, faces, band_uv(band, points[:, 1] * 0.3 + 0.2, points[:, 2] * 0.5 + 0.5))
