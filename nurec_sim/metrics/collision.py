"""Contacts between the ego and actors: actor, time, side, severity.

Profiles: ``strict`` keeps the class of an actor's first contact as long as the actor exists, combines the classes of
simultaneous contacts, and ignores an actor that appears inside the ego until the two have separated once. ``alpasim``
follows AlpaSim: every frame is classified independently, the last touching actor determines the class of the frame,
initial overlaps count. Both shrink and round the boxes; only ``strict`` also requires overlapping heights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nurec_sim import geometry
from nurec_sim.metrics.boxes import BoxPath, actor_boxes, ego_boxes, heights_overlap, outline_gap
from nurec_sim.metrics.series import make_series, speed_of, times_of, unknown_series
from nurec_sim.types import Rollout, Series

PROFILES = ("strict", "alpasim")
SIDES = ("front", "rear", "lateral")
AT_FAULT_RULE = "front_or_lateral"
"""Rule for ``collision_at_fault``: the ego is at fault in front and lateral contacts, not in rear ones."""

SUB_STEPS = 10
"""Interpolation steps between two states to find the first contact."""
_ARC_TOLERANCE_M = 2e-3  # shapely's arcs are inscribed polygons, up to 0.6 mm inside the true outline


@dataclass(frozen=True)
class Contact:
    """The first counted contact between the ego and an actor."""

    actor: str
    label: str
    t_us: int
    side: str
    at_fault: bool
    rule: str
    ego_speed_mps: float
    delta_v_mps: float


def check_profile(profile: str) -> None:
    """Raises for an unknown profile.

    Raises:
        ValueError: the name is not in ``PROFILES``.
    """
    if profile not in PROFILES:
        raise ValueError(f"unknown metric profile '{profile}'; have {list(PROFILES)}")


def collision_series(rollout: Rollout, profile: str = "strict", actors_known: bool | None = None) -> list[Series]:
    """``collision_any/front/lateral/rear/at_fault`` and ``collision_delta_v_mps`` over time.

    Args:
        rollout: states and actors.
        profile: ``strict`` or ``alpasim``.
        actors_known: whether the log has actor labels; None: if the rollout has any actor. Without labels every series
            is invalid.
    """
    check_profile(profile)
    t_us = times_of(rollout)
    names = ("collision_any", *(f"collision_{side}" for side in ("front", "lateral", "rear")), "collision_at_fault")
    known = bool(rollout.actors) if actors_known is None else actors_known
    if not known or not rollout.states:
        return [unknown_series(name, t_us) for name in (*names, "collision_delta_v_mps")]
    # The per-side flags may combine several actors; delta-v is per contact, so it comes from ``find_contacts``.
    sides = _side_flags(rollout, profile)
    flags = {f"collision_{side}": sides[side] for side in SIDES}
    flags["collision_any"] = np.logical_or.reduce([sides[side] for side in SIDES])
    flags["collision_at_fault"] = sides["front"] | sides["lateral"]
    series = [make_series(name, t_us, flags[name]) for name in names]
    delta_v = np.full(len(t_us), np.nan)
    for contact in find_contacts(rollout, profile):
        index = int(np.searchsorted(t_us, contact.t_us))
        delta_v[index] = np.fmax(delta_v[index], contact.delta_v_mps)
    return [*series, make_series("collision_delta_v_mps", t_us, delta_v)]


def find_contacts(rollout: Rollout, profile: str = "strict") -> list[Contact]:
    """One contact per actor touched while the policy drives, in time order."""
    check_profile(profile)
    if not rollout.states:
        return []
    t_us = rollout.t_us
    ego, found = ego_boxes(rollout), []
    ego_velocity = speed_of(rollout.world_from_rig, t_us)
    for actor, box in actor_boxes(rollout).items():
        counted = np.flatnonzero(_counted(ego, box, profile, t_us >= rollout.first_closed_loop_us))
        if len(counted) == 0:
            continue
        index = int(counted[0])
        side = _first_side(ego, box, index, profile)
        # Plastic impact of equal masses: both leave with the mean velocity, so each changes by half the difference.
        relative = ego_velocity[index] - speed_of(box.world_from_box, t_us)[index]
        found.append(
            Contact(
                actor, rollout.actor_labels.get(actor, ""), int(t_us[index]), side, side != "rear", AT_FAULT_RULE,
                float(np.linalg.norm(ego_velocity[index])), float(np.linalg.norm(relative)) / 2,
            )
        )  # fmt: skip
    return sorted(found, key=lambda contact: (contact.t_us, contact.actor))


def touching(ego: BoxPath, actor: BoxPath) -> np.ndarray:
    """[t] bool: outlines touch and heights overlap; False while the actor is absent."""
    return (outline_gap(ego, actor) <= 0.0) & heights_overlap(ego, actor)


def contact_side(ego: BoxPath, actor: BoxPath) -> str:
    """Contact side on the ego for boxes at one time: ``front``, ``rear`` or ``lateral``.

    The bumper regions are the front and the rear edge of the box grown by the corner radius, clipped to the outline;
    the front region takes precedence.
    """
    import shapely

    outline, other = _outline(ego), _outline(actor)
    corners = geometry.box_corners_xy(ego.world_from_box[0], *ego.length_width_m)
    for side, edge in (("front", corners[[0, 3]]), ("rear", corners[[1, 2]])):
        bumper = shapely.intersection(shapely.buffer(shapely.linestrings(edge), ego.radius_m), outline)
        if shapely.distance(bumper, other) <= _ARC_TOLERANCE_M:
            return side
    return "lateral"


def _outline(box: BoxPath):
    """Rounded outline of a box at its first time as a shapely geometry."""
    import shapely

    # The hull of a box without area is a line or a point, where a polygon would be empty.
    core = shapely.convex_hull(shapely.multipoints(geometry.box_corners_xy(box.world_from_box[0], *box.core_m)))
    return shapely.buffer(core, box.radius_m) if box.radius_m > 0 else core


def _counted(ego: BoxPath, actor: BoxPath, profile: str, relevant: np.ndarray) -> np.ndarray:
    """[t] counted contacts while the policy drives.

    ``strict`` ignores overlaps that exist when an actor appears or at the end of the log replay (where the ego is at
    its recorded pose, so the boxes are wrong, not the policy) until the two have separated.
    """
    touches = touching(ego, actor)
    if profile == "alpasim":
        return touches & relevant
    # ``armed`` becomes true at a state without contact and stays so while the actor is present and the policy drives.
    present, counted, armed = actor.present, np.zeros(len(touches), bool), False
    for index in range(len(touches)):
        armed = bool(present[index]) and ((armed and bool(relevant[index])) or not touches[index])
        counted[index] = armed and touches[index]
    return counted


def _first_side(ego: BoxPath, actor: BoxPath, index: int, profile: str) -> str:
    """Side of a contact first detected at a state.

    A car moves metres between two states, enough for a pedestrian to end up behind its bumper, so ``strict``
    interpolates the first contact from the previous state on.
    """
    if profile == "strict" and index > 0 and ego.present[index - 1] and actor.present[index - 1]:
        on_the_way = np.arange(1, SUB_STEPS + 1) / SUB_STEPS
        ego, actor = (
            BoxPath(geometry.interpolate_pose_pair(box.world_from_box[index - 1 : index + 1], on_the_way), box.size_m)
            for box in (ego, actor)
        )
        index = int(np.argmax(touching(ego, actor)))
    return contact_side(ego.at([index]), actor.at([index]))


def _side_flags(rollout: Rollout, profile: str) -> dict[str, np.ndarray]:
    """Per side, [t] whether there is a contact."""
    ego = ego_boxes(rollout)
    flags = {side: np.zeros(len(rollout.states), bool) for side in SIDES}
    relevant = rollout.t_us >= rollout.first_closed_loop_us
    for box in actor_boxes(rollout).values():
        times: Sequence[int] = np.flatnonzero(_counted(ego, box, profile, relevant)).tolist()
        first_side = _first_side(ego, box, times[0], profile) if times else ""
        for index in times:
            if profile == "strict":
                flags[first_side][index] = True
                continue
            for side in SIDES:  # AlpaSim resets the flags for every touching actor, so only the last one counts
                flags[side][index] = False
            flags[contact_side(ego.at([index]), box.at([index]))][index] = True
    return flags
