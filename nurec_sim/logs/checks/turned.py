"""Alternative interpretations of a camera's calibration: inverted, rotated, or with permuted axes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from nurec_sim import geometry
from nurec_sim.types import Matrix4

UPRIGHT = 0.3
SMALL_DEG = 3.0
AXES = "xyz"


def is_upright(rig_from_camera: Matrix4) -> bool:
    """Whether the top of the image points up rather than to a side or down."""
    # The camera's y axis points down in the image: minus its z component in the rig is the image's upward tilt.
    return bool(-rig_from_camera[2, 1] > UPRIGHT)


def wrong_readings(rig_from_camera: Matrix4, rig_from_log: Matrix4) -> Iterator[tuple[str, Matrix4]]:
    """Alternative interpretations of a camera pose, with descriptions.

    Vehicle cameras are mounted upright: of all quarter turns, only those that result in an upright image count.

    Args:
        rig_from_camera: the given pose.
        rig_from_log: pose, in the rig frame, of the log's ego frame, to which its calibration refers.
    """
    for name, pose in _readings(rig_from_camera, rig_from_log):
        if is_upright(pose):
            yield name, pose


def _readings(given: Matrix4, rig_from_log: Matrix4) -> Iterator[tuple[str, Matrix4]]:
    written = geometry.inverse(rig_from_log) @ given
    yield "inverted (T_ego_cam takes points of the camera to the ego frame)", rig_from_log @ geometry.inverse(written)
    yield "with its rotation transposed", geometry.pose(given[:3, :3].T, given[:3, 3])
    for turn in _quarter_turns():
        yield _name(turn), given @ geometry.pose(turn, np.zeros(3))
        # Turns about z are also applied in the rig frame: a confused mounting direction rather than camera axes.
        if np.count_nonzero(np.diag(turn) == 1) == 1 and turn[2, 2] == 1:
            angle = round(np.degrees(geometry.yaw_of(turn))) % 360
            yield f"turned by {angle} degrees about the car's z axis", geometry.pose(turn, np.zeros(3)) @ given


def slightly_turned(rig_from_camera: Matrix4) -> Iterator[tuple[str, Matrix4]]:
    """The camera rotated by 3 degrees in both directions about each of its axes."""
    c, s = np.cos(np.radians(SMALL_DEG)), np.sin(np.radians(SMALL_DEG))
    for axis, sign in itertools.product(range(3), (1, -1)):
        turn = np.eye(3)
        a, b = (axis + 1) % 3, (axis + 2) % 3
        turn[[a, a, b, b], [a, b, a, b]] = c, -sign * s, sign * s, c
        name = f"turned by {sign * SMALL_DEG:+g} degrees about its {AXES[axis]} axis"
        yield name, rig_from_camera @ geometry.pose(turn, np.zeros(3))


def _quarter_turns() -> Iterator[np.ndarray]:
    """The 23 axis-aligned rotations other than the identity."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            # Signed permutations: 48, of which the 24 with determinant 1 are rotations.
            if np.linalg.det(turn) > 0 and not np.array_equal(turn, np.eye(3)):
                yield turn


def _name(turn: np.ndarray) -> str:
    fixed = np.flatnonzero(np.diag(turn) == 1)
    if len(fixed) == 1:
        a, b = (fixed[0] + 1) % 3, (fixed[0] + 2) % 3
        angle = round(np.degrees(np.arctan2(turn[b, a], turn[a, a]))) % 360
        return f"turned by {angle} degrees about its {AXES[fixed[0]]} axis"
    taken = ", ".join(("-" if column.sum() < 0 else "") + AXES[int(np.argmax(np.abs(column)))] for column in turn.T)
    return f"with its axes x, y, z taken for {taken}"
