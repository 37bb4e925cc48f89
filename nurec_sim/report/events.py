"""The events of a rollout, each with its reason, and the order of rollouts: most different and worst first."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from nurec_sim.report.data import ReportRollout
from nurec_sim.report.reasons import beside_path_m, contact_reason, offroad_reason

EXTRAPOLATED_M = 1.0
"""Beyond this distance from the recorded path pictures are called extrapolated."""


@dataclass(frozen=True)
class Happening:
    """One event: ``text`` is what, ``reason`` why; both plain text."""

    t_us: int
    text: str
    reason: str = ""


def first_offroad_us(entry: ReportRollout) -> int | None:
    """Time of the first off-road state, if there is one."""
    series = entry.series.get("offroad")
    if series is None:
        return None
    hits = series.t_us[series.valid & (np.nan_to_num(series.values) > 0.5)]
    return int(hits[0]) if len(hits) else None


def first_event_us(entry: ReportRollout) -> int | None:
    """Time of the first contact or off-road state, if there is one."""
    times = [contact.t_us for contact in entry.contacts] + [first_offroad_us(entry)]
    return min((t for t in times if t is not None), default=None)


def happenings(entry: ReportRollout) -> list[Happening]:
    """All events of a rollout in time order."""
    rollout, found = entry.rollout, []
    for c in entry.contacts:
        fault = f"{'at fault' if c.at_fault else 'not at fault'} ({c.rule.replace('_', ' ')})"
        text = (
            f"{c.side} contact with {c.label or 'actor'} {c.actor}, ego at {c.ego_speed_mps:.1f} m/s, change of speed "
            f"{c.delta_v_mps:.1f} m/s, {fault}"
        )
        found.append(Happening(c.t_us, text, _with_distance(entry, c.t_us, contact_reason(rollout, c))))
    left_us = first_offroad_us(entry)
    if left_us is not None:
        found.append(Happening(left_us, "off-road", _with_distance(entry, left_us, offroad_reason(rollout, left_us))))
    found += [Happening(e.t_us, f"{e.kind.replace('_', ' ')}: {e.text}") for e in rollout.events]
    return sorted(found, key=lambda one: (one.t_us, one.text))


def verdict(entry: ReportRollout) -> tuple[str, ...]:
    """What happened in a few words; the same words for the same verdict."""
    if entry.rollout.status != "ok":
        return ("failed",)
    words = [f"{side} collision" for side in dict.fromkeys(contact.side for contact in entry.contacts)]
    offroad = entry.series["offroad"]
    if first_offroad_us(entry) is not None:
        words.append("off-road")
    elif not offroad.valid.any():
        words.append("off-road unknown")
    if not entry.series["collision_any"].valid.any():
        words.append("collisions unknown")
    return tuple(words)


def changed_by_seed(entries: Iterable[ReportRollout]) -> set[tuple[str, str, str]]:
    """Scene, reconstruction and policy of the rollouts that end differently from another seed."""
    ends: dict[tuple[str, str, str], set[tuple[str, ...]]] = {}
    for entry in entries:
        ends.setdefault(drive_of(entry), set()).add(verdict(entry))
    return {drive for drive, verdicts in ends.items() if len(verdicts) > 1}


def drive_of(entry: ReportRollout) -> tuple[str, str, str]:
    """What all seeds of a rollout share: scene, reconstruction and policy."""
    return entry.rollout.scene_id, entry.rollout.reconstruction, entry.rollout.policy


def farthest_apart(group: Sequence[ReportRollout]) -> tuple[float, float]:
    """Largest distance (m) of the car between the first and any other rollout, and when (s after the start)."""
    first, best = group[0].rollout, (0.0, 0.0)
    for other in (entry.rollout for entry in group[1:]):
        count = min(len(first.states), len(other.states))
        if not count:
            continue
        gaps = np.linalg.norm((first.world_from_rig[:count] - other.world_from_rig[:count])[:, :3, 3], axis=1)
        worst = int(gaps.argmax())
        best = max(best, (float(gaps[worst]), float(first.t_us[worst] - first.t_us[0]) / 1e6))
    return best


def grouped(entries: Iterable[ReportRollout], worlds: Sequence[str]) -> list[list[ReportRollout]]:
    """Rollouts of one scene, policy and seed together, in the order of ``worlds``, or each by itself without.

    First come those whose reconstructions disagree, then those that drove farthest apart, then the worst: failures,
    collisions, off-road, and the longest way from the recorded path.
    """
    groups: dict[tuple[str, str, int, str], list[ReportRollout]] = {}
    for entry in entries:
        rollout = entry.rollout
        alone = "" if worlds else rollout.reconstruction
        groups.setdefault((rollout.scene_id, rollout.policy, rollout.seed, alone), []).append(entry)
    for group in groups.values() if worlds else ():
        group.sort(key=lambda entry: worlds.index(entry.rollout.reconstruction))
    return [groups[key] for key in sorted(groups, key=lambda key: (_urgency(groups[key]), key))]


def _urgency(group: Sequence[ReportRollout]) -> tuple[float, ...]:
    """Sorts the most urgent group first."""
    verdicts = [verdict(entry) for entry in group]
    weight = {"failed": 8, "front collision": 4, "lateral collision": 4, "off-road": 3, "rear collision": 2}
    worst = max(sum(weight.get(word, 0) for word in words) for words in verdicts)
    away = max((entry.series["dist_to_gt_trajectory"].value() for entry in group), default=0.0)
    return (
        -float(len(set(verdicts)) > 1), -round(farthest_apart(group)[0], 1), -float(worst),
        -away if np.isfinite(away) else 0.0,
    )  # fmt: skip


def _with_distance(entry: ReportRollout, t_us: int, reason: str) -> str:
    """The reason, and whether pictures there show what no sensor recorded."""
    beside = abs(beside_path_m(entry.rollout, t_us))
    if beside < EXTRAPOLATED_M:
        return reason
    return f"{reason}; {beside:.1f} m beside the recorded path, so what sensors showed there was extrapolated"
