"""How far to trust verdicts: where what sensors showed was extrapolated, and which verdicts change with the seed."""

from __future__ import annotations

from collections.abc import Sequence

from nurec_sim.report.cells import escape, first_five
from nurec_sim.report.data import ReportRollout
from nurec_sim.report.events import EXTRAPOLATED_M, changed_by_seed, drive_of
from nurec_sim.report.rollout_card import dot
from nurec_sim.report.support import support_by_distance

DISTANCES_M = (0.5, 1.0, 2.0, 4.0)


def trust(rollouts: Sequence[ReportRollout], worlds: Sequence[str]) -> str:
    """How far from the recorded path each policy drove, what its sensors showed there, and what another seed changes.

    Args:
        rollouts: all rollouts.
        worlds: order of the reconstructions.
    """
    rows = []
    by_policy: dict[tuple[str, str], list[ReportRollout]] = {}
    for entry in rollouts:
        by_policy.setdefault((entry.rollout.policy, entry.rollout.reconstruction), []).append(entry)
    for policy, world in sorted(by_policy, key=lambda key: (key[0], worlds.index(key[1]))):
        distances = [
            float(value)
            for entry in by_policy[policy, world]
            for value, valid in zip(
                entry.series["dist_to_gt_trajectory"].values, entry.series["dist_to_gt_trajectory"].valid, strict=True
            )
            if valid
        ]
        name = f"<small>{dot(worlds.index(world))}{escape(world)}</small>" if len(worlds) > 1 else ""
        if not distances:
            cells = '<td class="n"><span class="none">unknown</span></td>' * (len(DISTANCES_M) + 1)
        else:
            shares = [sum(d > limit for d in distances) / len(distances) for limit in DISTANCES_M]
            cells = f'<td class="n">{max(distances):.1f} m</td>' + "".join(
                f'<td class="n{" bad" if share and limit >= EXTRAPOLATED_M else ""}">{100 * share:.0f} %</td>'
                for share, limit in zip(shares, DISTANCES_M, strict=True)
            )
        rows.append(f"<tr><td><b>{escape(policy)}</b>{name}</td>{cells}</tr>")
    heads = "".join(f'<th class="n">beyond {limit:g} m</th>' for limit in DISTANCES_M)
    return (
        '<h2>What was extrapolated</h2><div class="card scroll"><p>Cameras and LiDARs recorded the scene from the '
        "recorded path only. The farther a policy drives from it, the more of what its sensors show was never seen "
        f"from there. Trust verdicts that fall within {EXTRAPOLATED_M:g} m; look at the video before you believe "
        "others.</p>"
        f'<table><thead><tr><th>Policy</th><th class="n">farthest</th>{heads}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table>"
        '<p class="key">Share of the time that the policy drove, by distance from the recorded path.</p>'
        f"{support_by_distance(rollouts, worlds)}{_changed_by_seed(rollouts)}</div>"
    )


def _changed_by_seed(rollouts: Sequence[ReportRollout]) -> str:
    """Which verdicts hold for one start only; empty with one seed."""
    if len({entry.rollout.seed for entry in rollouts}) < 2:
        return ""
    changed = sorted(changed_by_seed(rollouts))
    names = [f"<b>{escape(policy)}</b> in {escape(scene)} ({escape(world)})" for scene, world, policy in changed]
    if names:
        said = f"These end differently from one seed to another:<ul>{first_five(names)}</ul>"
    elif _drives_differ(rollouts):
        said = "None does."
    else:
        said = "All seeds drove the same. Without a <code>perturbation</code> in the scenario this says nothing."
    return (
        f"<h3>Verdicts that change with the seed</h3><p>{said}</p>"
        '<p class="key">Seeds differ in the start, as far as the scenario scatters it, and in the noise of policies. '
        "In studies verdicts that change with the seed contradicted the true world several times as often as "
        "others (docs/trust.md).</p>"
    )


def _drives_differ(rollouts: Sequence[ReportRollout]) -> bool:
    """Whether a policy drove otherwise with another seed."""
    drives: dict[tuple[str, str, str], set[bytes]] = {}
    for entry in rollouts:
        if entry.rollout.states:
            drives.setdefault(drive_of(entry), set()).add(entry.rollout.world_from_rig.tobytes())
    return any(len(different) > 1 for different in drives.values())
