"""Objects followed from sweep to sweep: a Kalman filter of constant velocity, then a smoother over the whole life.

The filter predicts where each object will be, the cheapest assignment (``scipy.optimize.linear_sum_assignment``) gives
it a blob there. Rauch, Tung and Striebel (1965) then give the velocities that all sightings together say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment

from nurec_sim.reconstruct.movers.objects import Blob

FIRST_MPS = 12.0
"""Standard deviation of the velocity of an object that was seen once."""
PLACE_M = 0.4
"""Standard deviation of the middle of what is seen of an object."""
ACCELERATION_MPS2 = 3.0
GATE = 3.0
"""Largest distance between prediction and blob, in standard deviations."""
HIDDEN_US = 2_000_000
"""An object that was not seen for longer is another one when it is seen again."""


@dataclass
class Path:
    """One object: its blobs, and the filter's states (x, y, and their rates) before and after each of them."""

    blobs: list[Blob]
    state: Float64[np.ndarray, " 4"]
    covariance: Float64[np.ndarray, "4 4"]
    steps: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]] = field(default_factory=list)

    @classmethod
    def begun(cls, blob: Blob) -> Path:
        """An object that was seen for the first time."""
        covariance = np.diag([PLACE_M**2, PLACE_M**2, FIRST_MPS**2, FIRST_MPS**2])
        path = cls([blob], np.array([*blob.middle_m, 0.0, 0.0]), covariance)
        path.steps.append((path.state, path.covariance, path.state, path.covariance, 0.0))
        return path

    def predicted(self, t_us: int) -> tuple[Float64[np.ndarray, " 4"], Float64[np.ndarray, "4 4"]]:
        """State and covariance at a later time."""
        dt = (t_us - self.blobs[-1].t_us) / 1e6
        move = _transition(dt)
        one = np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]]) * ACCELERATION_MPS2**2
        return move @ self.state, move @ self.covariance @ move.T + np.kron(one, np.eye(2))

    def add(self, blob: Blob) -> None:
        """The object is seen again."""
        state, covariance = self.predicted(blob.t_us)
        dt = (blob.t_us - self.blobs[-1].t_us) / 1e6
        gain = covariance[:, :2] @ np.linalg.inv(covariance[:2, :2] + PLACE_M**2 * np.eye(2))
        self.state = state + gain @ (blob.middle_m - state[:2])
        self.covariance = covariance - gain @ covariance[:2]
        self.steps.append((state, covariance, self.state, self.covariance, dt))
        self.blobs.append(blob)

    def smoothed(self) -> Float64[np.ndarray, "t 4"]:
        """States at all sightings, given all of them."""
        states = [self.state]
        for (_, _, state, covariance, _), (expected, spread, _, _, dt) in zip(
            self.steps[-2::-1], self.steps[:0:-1], strict=True
        ):
            gain = covariance @ _transition(dt).T @ np.linalg.inv(spread)
            states.append(state + gain @ (states[-1] - expected))
        return np.array(states[::-1])


def follow(sweeps: Sequence[Sequence[Blob]]) -> list[Path]:
    """All objects, in the order in which they were first seen.

    Args:
        sweeps: the blobs of each sweep, in the order of time.
    """
    living: list[Path] = []
    ended: list[Path] = []
    for blobs in sweeps:
        if not blobs:
            continue
        t_us = max(blob.t_us for blob in blobs)
        ended += [path for path in living if path.blobs[-1].t_us < t_us - HIDDEN_US]
        living = [path for path in living if path.blobs[-1].t_us >= t_us - HIDDEN_US]
        pairs = _assigned(living, blobs)
        for path, blob in pairs.items():
            living[path].add(blobs[blob])
        taken = set(pairs.values())
        living += [Path.begun(blob) for number, blob in enumerate(blobs) if number not in taken]
    return sorted([*ended, *living], key=lambda path: path.blobs[0].t_us)


def _assigned(paths: Sequence[Path], blobs: Sequence[Blob]) -> dict[int, int]:
    """The blob of each path that has one within its gate."""
    if not paths:
        return {}
    middle, times = np.array([blob.middle_m for blob in blobs]), np.array([blob.t_us for blob in blobs])
    cost = np.full((len(paths), len(blobs)), 1e6)
    middle_us = int(np.median(times))
    for row, path in enumerate(paths):
        state, covariance = path.predicted(middle_us)
        spread = covariance[:2, :2] + PLACE_M**2 * np.eye(2)
        # Blobs of one sweep differ in time by a part of its duration.
        offset = middle - state[:2] - state[2:] * ((times - middle_us) / 1e6)[:, None]
        square = np.einsum("ni,ij,nj->n", offset, np.linalg.inv(spread), offset)
        # At the seam of a spinning scanner an object may be measured at the end of a sweep and soon again in the next.
        square = np.where(times > path.blobs[-1].t_us, square, np.inf)
        # The logarithm of the likelihood: who was seen often is sure of its place, and comes before who was seen once.
        cost[row] = np.where(square < GATE**2, square + np.log(np.linalg.det(spread)), 1e6)
    rows, columns = linear_sum_assignment(cost)
    return {int(r): int(c) for r, c in zip(rows, columns, strict=True) if cost[r, c] < 1e6}


def _transition(dt: float) -> Float64[np.ndarray, "4 4"]:
    move = np.eye(4)
    move[0, 2] = move[1, 3] = dt
    return move
