"""The report's opening where reconstructions are compared: what differs, rank agreement, fidelity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from nurec_sim.metrics.agreement import CONFIDENCE, EQUIVALENCE_MARGIN, Agreement, Difference, Estimate
from nurec_sim.report.cells import count_of, escape, first_five, list_items
from nurec_sim.report.charts import BARS
from nurec_sim.report.data import Comparison, ReportRollout, ReportScene, RunReport
from nurec_sim.report.events import farthest_apart, verdict
from nurec_sim.report.rollout_card import SAME_M, dot

SHOWN = {
    "collision_any": "Collision C",
    "offroad": "Off-road O",
    "collision_offroad_mean": "(C+O)/2",
    "scene_score": "Scene score",
    "progress": "Progress",
}
ALPHA = 1 - CONFIDENCE


def what_differs(report: RunReport, comparison: Comparison, groups: Sequence[Sequence[ReportRollout]]) -> str:
    """The opening: sentences, bars, and differences per policy.

    Args:
        report: the whole report.
        comparison: its comparison.
        groups: rollouts by scene, policy and seed, each in all reconstructions.
    """
    first = comparison.reference
    bars = "".join(
        f'<div><h3>{escape(title)}</h3><div class="plot" id="bars-{metric}"></div></div>'
        for metric, title in BARS.items()
    )
    legend = ", ".join(f"{dot(place)}<b>{escape(name)}</b>" for place, name in enumerate(comparison.worlds))
    return (
        f'<h2>What differs between the reconstructions</h2><div class="card"><p>{legend}. Others are compared with '
        f"{escape(first)}. Same policies, scenes, actors and seeds: only what the sensors show differs. Off-road is "
        f"judged by {escape(comparison.road)}.</p><ul>{list_items(_sentences(comparison, groups))}</ul>"
        f'<div class="panels">{bars}</div><p class="key">{_interval_text(report)} Collision and off-road: share of '
        "rollouts, lower is better. Scene score: 100 % is a drive without fault to the end.</p></div>"
        f"{differences(comparison)}"
    )


def _sentences(comparison: Comparison, groups: Sequence[Sequence[ReportRollout]]) -> list[str]:
    same, other, differ = [], [], []
    for place, group in enumerate(groups):
        rollout = group[0].rollout
        name = f'<a class="jump" href="#rollout{place}">{escape(rollout.policy)}</a>'
        verdicts = [verdict(entry) for entry in group]
        if len(set(verdicts)) > 1:
            said = "; ".join(
                f"{escape(entry.rollout.reconstruction)}: {escape(' and '.join(words) or 'no event')}"
                for entry, words in zip(group, verdicts, strict=True)
            )
            differ.append(f"{name} in {escape(rollout.scene_id)}, seed {rollout.seed}: {said}")
        elif farthest_apart(group)[0] <= SAME_M:
            same.append(rollout.policy)
        else:
            metres, at_s = farthest_apart(group)
            other.append(f"{name} in {escape(rollout.scene_id)}, seed {rollout.seed}: {metres:.1f} m, at {at_s:.1f} s")
    sentences = []
    if differ:
        sentences.append(
            f'<span class="bad">{count_of(len(differ), "rollout")} of {len(groups)} end differently</span>: '
            f"<ul>{first_five(differ)}</ul>"
        )
    else:
        sentences.append(
            f'<span class="good">No rollout ends differently</span>: the reconstructions agree on the verdict '
            f"(collision, off-road or neither) of all {len(groups)}."
        )
    if other:
        sentences.append(
            f"{count_of(len(other), 'rollout')} with the same verdict drove differently, farthest apart:"
            f"<ul>{first_five(other)}</ul>"
        )
    if same:
        sentences.append(
            f"{count_of(len(same), 'rollout')} drove exactly the same ({escape(', '.join(sorted(set(same))))}). "
            "Policies that see nothing rendered must; it shows that nothing but the sensors differs."
        )
    return sentences


def _interval_text(report: RunReport) -> str:
    scenes = report.values["clipgt_id"].n_unique()
    if scenes < 2:
        return "No intervals: a single scene does not generalise to others."
    return f"Whiskers: {100 * CONFIDENCE:.0f} % bootstrap intervals over {scenes} scenes."


def differences(comparison: Comparison) -> str:
    """Per policy: each other reconstruction minus the first one, as a table."""
    metrics = [metric for metric in SHOWN if any(key[0] == metric for key in comparison.agreements)]
    heads = "".join(f'<th class="n">{escape(SHOWN[metric])}</th>' for metric in metrics)
    rows = []
    for place, other in enumerate(comparison.worlds[1:], 1):
        found = {metric: comparison.agreements.get((metric, other)) for metric in metrics}
        for policy in sorted({policy for each in found.values() if each for policy in each.policies}):
            cells = "".join(_difference_cell(found[metric], policy) for metric in metrics)
            rows.append(f"<tr><td><b>{escape(policy)}</b><small>{dot(place)}{escape(other)}</small></td>{cells}</tr>")
    notes = f'<p class="key">{escape("; ".join(comparison.notes))}.</p>' if comparison.notes else ""
    margin = f"{100 * EQUIVALENCE_MARGIN:.0f}"
    return (
        f'<h3>Difference from {escape(comparison.reference)}</h3><div class="card scroll"><table><thead><tr>'
        f"<th>Policy</th>{heads}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
        f'<p class="key">In percentage points. <i>Equivalent</i>: within {margin} points, by two one-sided tests '
        f"(p below {ALPHA:.2f}); <i>differs</i>: the interval excludes 0; neither: the scenes are too few to say.</p>"
        f"{notes}</div>"
    )


def _difference_cell(found: Agreement | None, policy: str) -> str:
    if found is None or policy not in found.policies:
        return '<td class="n"><span class="none">unknown</span></td>'
    difference = found.differences[found.policies.index(policy)]
    return f'<td class="n">{points_cell(difference.estimate)}<small>{_judged(difference)}</small></td>'


def points_cell(estimate: Estimate) -> str:
    """A difference in percentage points with its interval."""
    interval = ""
    if estimate.low is not None and estimate.high is not None:
        interval = f"<small>[{100 * estimate.low:+.0f}, {100 * estimate.high:+.0f}]</small>"
    text = f"{100 * estimate.value:+.0f}" if abs(estimate.value) >= 0.005 else "0"
    return f"{text}{interval}"


def _judged(difference: Difference) -> str:
    if difference.p_equivalent is None:
        return ""
    if difference.p_equivalent < ALPHA:
        return "equivalent"
    return "differs" if difference.estimate.resolved else ""


def rank_agreement(comparison: Comparison) -> str:
    """Whether the reconstructions rank the policies alike."""
    rows = []
    for metric, title in SHOWN.items():
        for place, other in enumerate(comparison.worlds[1:], 1):
            found = comparison.agreements.get((metric, other))
            if found is not None and len(found.policies) > 1:
                name = f"{escape(title)}<small>{dot(place)}{escape(other)}</small>"
                rows.append(_agreement_row(name, found))
        ceiling = comparison.ceilings.get(metric)
        if ceiling is not None:
            rows.append(_agreement_row(f"<small>noise ceiling of {escape(title)}</small>", ceiling))
    if not rows:
        return ""
    some = next(iter(comparison.agreements.values()))
    flips = [
        f"{escape(SHOWN[metric])}: {escape(other)} puts {escape(a)} and {escape(b)} the other way round"
        for (metric, other), found in comparison.agreements.items()
        for a, b in found.pairs.flipped
    ]
    one_scene = (
        " With one scene no pair is resolved: the order above is that of this scene only." if some.scenes < 2 else ""
    )
    ceiling_text = (
        "The noise ceiling compares odd with even seeds of the reference: no reconstruction can be expected to agree "
        "better."
        if any(comparison.ceilings.values())
        else "With one seed per scene the noise ceiling is not known: repeat with several."
    )
    return (
        '<h2>Do they rank the policies alike?</h2><div class="card scroll"><table><thead><tr><th>Metric</th>'
        '<th class="n" title="Kendall: 1 the same order, 0 unrelated, -1 reversed; ties counted">tau-b</th>'
        '<th class="n" title="correlation of ranks">Spearman</th>'
        '<th class="n" title="mean maximum rank violation: 0 is perfect">MMRV, points</th>'
        '<th class="n">same order, resolved</th><th class="n">flipped, resolved</th><th class="n">resolved in one</th>'
        f'<th class="n">unresolved</th></tr></thead><tbody>{"".join(rows)}</tbody></table>'
        + (f'<ul class="bad">{list_items(flips)}</ul>' if flips else "")
        + f'<p class="key">Rank correlations over {count_of(len(some.policies), "policy", "policies")}, intervals over '
        f"{count_of(some.scenes, 'scene')}. A pair of policies is <i>resolved</i> where the interval of its difference "
        f"excludes 0. Orders are identical by luck with probability {some.p_by_luck:.2g}. "
        f"{ceiling_text}{one_scene} "
        "<i>All tied</i>: one reconstruction gives every policy the same value, so there is no order to compare."
        "</p></div>"
    )


def _agreement_row(name: str, found: Agreement) -> str:
    pairs = found.pairs
    bad = ' class="n bad"' if pairs.opposite else ' class="n"'
    return (
        f'<tr><td>{name}</td><td class="n">{rank_cell(found.tau_b)}</td><td class="n">{rank_cell(found.spearman)}</td>'
        f'<td class="n">{100 * found.mmrv:.1f}</td><td class="n">{pairs.same}</td><td{bad}>{pairs.opposite}</td>'
        f'<td class="n">{pairs.resolved_in_one}</td><td class="n">{pairs.unresolved}</td></tr>'
    )


def rank_cell(estimate: Estimate) -> str:
    """A rank correlation with its interval."""
    if estimate.value != estimate.value:
        return '<span class="none">all tied</span>'
    interval = f"<small>[{estimate.low:.2f}, {estimate.high:.2f}]</small>" if estimate.low is not None else ""
    return f"{estimate.value:.2f}{interval}"


def fidelity(scenes: Sequence[ReportScene], worlds: Sequence[str]) -> str:
    """How true each reconstruction is to its log.

    Args:
        scenes: all reconstructions of the run.
        worlds: their order.
    """
    measured = sorted((s for s in scenes if s.fidelity), key=lambda s: (s.id, worlds.index(s.reconstruction)))
    if not measured:
        return (
            '<h2>How true are they?</h2><div class="card"><p class="none">Not measured: give the log as well '
            "(--clip), or let --methods reconstruct it.</p></div>"
        )
    rows = [_fidelity_row(scene, worlds.index(scene.reconstruction)) for scene in measured]
    seen = [scene for scene in measured if not scene.fidelity["held_out"]]
    text = (
        "Images and sweeps that the reconstruction did not see."
        if not seen
        else "The images and sweeps were seen by the reconstructions, so these figures flatter."
    )
    return (
        '<h2>How true are they?</h2><div class="card scroll"><table><thead><tr><th>Reconstruction</th>'
        '<th class="n">Gaussians</th><th class="n">Images, PSNR</th><th class="n">SSIM</th>'
        '<th class="n">LiDAR, median error</th><th class="n">LiDAR, returns found</th>'
        '<th class="n">Road agrees with map</th><th class="n">Road unknown</th></tr></thead>'
        f'<tbody>{"".join(rows)}</tbody></table><p class="key">{text} On the recorded path only: beside it nothing was '
        "recorded to compare with.</p></div>"
    )


def _fidelity_row(scene: ReportScene, place: int) -> str:
    figures = scene.fidelity
    road: Mapping[str, Any] = figures.get("road") or {}
    count = sum(scene.counts.get(name, 0) for name in ("static", "dynamic"))
    cells = (
        f"{count:,}", _number(figures["psnr_db"], "{:.2f} dB"), _number(figures["ssim"], "{:.3f}"),
        _number(figures["range_error_m"], "{:.3f} m"), _number(figures["return_recall"], "{:.1%}"),
        _number(road.get("agreement"), "{:.1%}"), _number(road.get("unknown_frac"), "{:.1%}"),
    )  # fmt: skip
    name = f"<b>{dot(place)}{escape(scene.reconstruction)}</b><small>{escape(scene.id)}</small>"
    return f"<tr><td>{name}</td>" + "".join(f'<td class="n">{cell}</td>' for cell in cells) + "</tr>"


def _number(value: object, form: str) -> str:
    return form.format(value) if isinstance(value, (int, float)) else '<span class="none">none</span>'
