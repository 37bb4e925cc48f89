"""Junctions: the mouths of their roads, and connecting paths of lines and arcs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from nurec_sim import geometry
from nurec_sim.world.plan.road import RoadLanes
from nurec_sim.world.plan.town import Arm, Connection, Junction, Road, RoadPiece

SHARPEST_TURN_RAD = np.radians(140.0)
STRAIGHT_RAD = np.radians(30.0)
MOUTH_MARGIN_M = 0.5
Pose2 = tuple[np.ndarray, float]
"""Position [2] and heading."""


@dataclass(frozen=True)
class Mouth:
    """An arm of a junction, seen from the junction: direction and cross-section."""

    arm: Arm
    line: RoadLanes

    @property
    def outward(self) -> bool:
        """Whether the road's stations grow away from the junction."""
        return self.arm.end == "start"

    @property
    def station_m(self) -> float:
        """Station at which the road meets the junction."""
        return 0.0 if self.outward else self.line.length_m

    def pose(self, offset_m: float = 0.0) -> Pose2:
        """A position across the mouth (offset to the road's own left), heading away from the junction."""
        xy, yaw = self.line.at(self.station_m, offset_m)
        return xy, float(yaw) + (0.0 if self.outward else np.pi)

    def lanes(self, inbound: bool) -> list[int]:
        """Numbers of the lanes into or out of the junction, from the centre line outwards."""
        backward = inbound == self.outward
        count = self.line.count(1 if backward else -1)
        return [k if backward else -k for k in range(1, count + 1)]

    def lane_pose(self, number: int, inbound: bool) -> Pose2:
        """Where a lane meets the junction, with its heading of travel."""
        xy, outward = self.pose(float(self.line.lane_offset_m(number, self.station_m)))
        return xy, outward + (np.pi if inbound else 0.0)


def reaches(arms: Sequence[tuple[float, float, float]], corner_radius_m: float) -> list[float]:
    """Distance of the mouths from the centre of a crossing that leaves space for kerbs of a given radius.

    Args:
        arms: per arm its direction (rad, counter-clockwise order), and its width to the left and to the right of its
            centre line as seen from the junction.
        corner_radius_m: radius of the kerb between neighbouring arms.
    """
    needed = [MOUTH_MARGIN_M] * len(arms)
    for a in range(len(arms)):
        b = (a + 1) % len(arms)
        angle = (arms[b][0] - arms[a][0]) % (2 * np.pi)
        # Nearly straight neighbours have no corner to round.
        if len(arms) < 2 or angle > np.radians(160.0):
            continue
        left_of_a, right_of_b, tangent = arms[a][1], arms[b][2], corner_radius_m / np.tan(angle / 2)
        # Where the left edge of a meets the right edge of b, measured along each arm; the arc of the kerb begins r /
        # tan(angle / 2) further out.
        corner_a = (right_of_b + left_of_a * np.cos(angle)) / np.sin(angle)
        corner_b = (left_of_a + right_of_b * np.cos(angle)) / np.sin(angle)
        needed[a] = max(needed[a], float(corner_a + tangent) + MOUTH_MARGIN_M)
        needed[b] = max(needed[b], float(corner_b + tangent) + MOUTH_MARGIN_M)
    return needed


def join(start: Pose2, end: Pose2) -> tuple[RoadPiece, ...]:
    """A smooth path between two poses: line, arc, line where their tangents meet, else two arcs."""
    (p, from_yaw), (q, to_yaw) = start, end
    u, v = (np.array([np.cos(yaw), np.sin(yaw)]) for yaw in (from_yaw, to_yaw))
    turn, chord = _wrapped(to_yaw - from_yaw), q - p
    # The sine of the turn: zero for parallel poses, which make a straight line if they also lie on one.
    cross = float(u[0] * v[1] - u[1] * v[0])
    if abs(cross) < 1e-9 and abs(float(u[0] * chord[1] - u[1] * chord[0])) < 1e-6 and float(u @ v) > 0:
        return (RoadPiece(float(np.hypot(*chord))),)
    if abs(cross) > 1e-3:
        # Cramer's rule: distances from the start, and back from the end, to the point where the tangents meet.
        before = float(chord[0] * v[1] - chord[1] * v[0]) / cross
        after = float(u[0] * chord[1] - u[1] * chord[0]) / cross
        if before > 0.5 and after > 0.5:
            # An arc of curvature k that turns by an angle has tangents of length tan(turn / 2) / k.
            tangent = min(before, after)
            curvature = np.tan(turn / 2) / tangent
            pieces = [RoadPiece(turn / curvature, float(curvature), float(curvature))]
            if before - tangent > 1e-6:
                pieces.insert(0, RoadPiece(before - tangent))
            if after - tangent > 1e-6:
                pieces.append(RoadPiece(after - tangent))
            return tuple(pieces)
    # Two arcs with equal tangents d (a biarc): |chord - d (u + v)| = 2 d, a quadratic equation in d. The arcs meet in
    # the middle of the inner control points.
    both, bend = float(chord @ (u + v)), 2 * (1 - float(u @ v))
    handle = (np.sqrt(both**2 + bend * float(chord @ chord)) - both) / bend if bend > 1e-9 else float(
        chord @ chord) / (2 * both)  # fmt: skip
    middle = (p + handle * u + q - handle * v) / 2
    first, second = _arc(middle - p, u), _arc(q - middle, v, at_end=True)
    return first, second


def _arc(chord: np.ndarray, tangent: np.ndarray, at_end: bool = False) -> RoadPiece:
    """The arc over a chord with the given tangent at its start (or its end)."""
    # Between tangent and chord lies half the turn: chord = 2 R sin(angle), length = 2 R angle.
    angle = float(np.arctan2(tangent[0] * chord[1] - tangent[1] * chord[0], tangent @ chord)) * (-1 if at_end else 1)
    curvature = 2 * np.sin(angle) / float(np.hypot(*chord))
    return RoadPiece(float(np.hypot(*chord) / np.sinc(angle / np.pi)), float(curvature), float(curvature))


def ring_path(start: Pose2, end: Pose2, centre: np.ndarray, ring_m: float, flare_m: float) -> tuple[RoadPiece, ...]:
    """Into a roundabout from a lane, counter-clockwise along its ring, and out into another lane.

    Both lanes run parallel to the line from the centre through the middle of their road.

    Args:
        start: position (m) and heading (rad) at which the path enters.
        end: position and heading at which it leaves.
        centre: of the ring [2] (m).
        ring_m: radius of the middle of the ring's lane.
        flare_m: radius of the arcs that lead in and out.

    Raises:
        ValueError: the flares do not fit between the lane and the ring.
    """
    pieces: list[RoadPiece] = []
    angles = []
    for (xy, yaw), sign in ((start, 1.0), (end, -1.0)):
        inward = np.array([np.cos(yaw), np.sin(yaw)]) * sign
        from_centre = xy - centre
        along = -float(inward @ from_centre)
        aside = abs(float(inward[0] * from_centre[1] - inward[1] * from_centre[0]))
        # The flare touches the lane and, from outside, the ring: its centre is aside + flare from the axis and ring +
        # flare from the centre of the roundabout.
        depth = np.sqrt((ring_m + flare_m) ** 2 - (aside + flare_m) ** 2)
        turn = float(np.arcsin((aside + flare_m) / (ring_m + flare_m)))
        if along < depth:
            raise ValueError(f"a flare of {flare_m} m needs the mouth {depth:.1f} m from the centre, got {along:.1f} m")
        axis = float(np.arctan2(-inward[1], -inward[0]))
        angles.append(axis + sign * turn)
        pieces += [RoadPiece(along - float(depth)), RoadPiece((np.pi / 2 - turn) * flare_m, -1 / flare_m, -1 / flare_m)]
    round_the_ring = (angles[1] - angles[0]) % (2 * np.pi)
    ring = RoadPiece(float(round_the_ring * ring_m), 1 / ring_m, 1 / ring_m)
    line_in, arc_in, line_out, arc_out = pieces
    return tuple(piece for piece in (line_in, arc_in, ring, arc_out, line_out) if piece.length_m > 1e-9)


def connections(junction: str, mouths: Sequence[Mouth], ring: tuple[np.ndarray, float, float] | None = None
                ) -> tuple[Connection, ...]:  # fmt: skip
    """Every allowed path through a junction; ``ring`` is a roundabout's centre, radius and flare.

    Left turns go from and to the innermost lane, right turns from and to the outermost, and straight lanes keep their
    index. There are no U-turns.
    """
    found: list[Connection] = []
    for a, source in enumerate(mouths):
        inbound = source.lanes(inbound=True)
        for b, target in enumerate(mouths):
            outbound = target.lanes(inbound=False)
            if a == b or not inbound or not outbound:
                continue
            # Both mouths head outwards, so going straight on is a difference of pi.
            change = _wrapped(target.pose()[1] - source.pose()[1] - np.pi)
            if ring is None and abs(change) > SHARPEST_TURN_RAD:
                continue
            turn: Literal["straight", "left", "right"]
            turn = "straight" if abs(change) < STRAIGHT_RAD else "left" if change > 0 else "right"
            if turn == "left":
                pairs = [(inbound[0], outbound[0])]
            # Ramps leave and join the outermost lane.
            elif turn == "right" or _has_ramp(source, target):
                pairs = [(inbound[-1], outbound[-1])]
            else:
                pairs = [(lane, outbound[min(k, len(outbound) - 1)]) for k, lane in enumerate(inbound)]
            for lane_in, lane_out in pairs:
                start, end = source.lane_pose(lane_in, True), target.lane_pose(lane_out, False)
                pieces = join(start, end) if ring is None else ring_path(start, end, *ring)
                found.append(Connection(
                    f"{junction}:{len(found)}", f"{source.arm.road}:{lane_in}", f"{target.arm.road}:{lane_out}", turn,
                    float(start[0][0]), float(start[0][1]), _wrapped(start[1]), pieces))  # fmt: skip
    return tuple(found)


def _wrapped(angle_rad: float) -> float:
    """The same angle in -pi..pi."""
    return float(geometry.wrap_angle(np.array(angle_rad)))


def _has_ramp(*mouths: Mouth) -> bool:
    """Whether one of the roads is a ramp, which leaves or joins the outermost lane."""
    return any(not mouth.lanes(True) or not mouth.lanes(False) for mouth in mouths)


def crossing(junction: str, kind: Literal["crossing", "fork"], centre: np.ndarray, arms: Sequence[Arm],
             roads: dict[str, Road], corner_radius_m: float) -> Junction:  # fmt: skip
    """A junction of roads that already end at its mouths.

    Args:
        junction: id of the junction.
        kind: ``crossing``, or ``fork`` for a ramp.
        centre: of the junction [2] (m).
        arms: ends of roads that meet, with their traffic control.
        roads: at least the roads of the arms, by id.
        corner_radius_m: radius of the kerbs between neighbouring arms.
    """
    mouths = [Mouth(arm, RoadLanes(roads[arm.road])) for arm in arms]
    return Junction(junction, kind, float(centre[0]), float(centre[1]), corner_radius_m, tuple(arms),
                    connections(junction, mouths))  # fmt: skip


def roundabout(junction: str, centre: np.ndarray, arms: Sequence[Arm], roads: dict[str, Road], corner_radius_m: float,
               ring_radius_m: float, ring_width_m: float, flare_m: float) -> Junction:  # fmt: skip
    """A roundabout, entered to the right and driven counter-clockwise.

    Args:
        junction: id of the junction.
        centre: of the ring [2] (m).
        arms: ends of roads that meet, with their traffic control.
        roads: at least the roads of the arms, by id.
        corner_radius_m: radius of the kerbs between arms and ring.
        ring_radius_m: radius of the middle of the ring's lane.
        ring_width_m: width of the ring.
        flare_m: radius of the arcs from lanes into the ring and out of it.
    """
    mouths = [Mouth(arm, RoadLanes(roads[arm.road])) for arm in arms]
    paths = connections(junction, mouths, (centre, ring_radius_m, flare_m))
    return Junction(junction, "roundabout", float(centre[0]), float(centre[1]), corner_radius_m, tuple(arms), paths,
                    ring_radius_m, ring_width_m)  # fmt: skip
