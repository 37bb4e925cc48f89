"""The report of a study: one HTML file that opens without a server or a network."""

from __future__ import annotations

from nurec_sim.metrics.agreement import CONFIDENCE, Estimate
from nurec_sim.report.cells import count_of, escape, list_items
from nurec_sim.report.charts import BARS, comparison_bars
from nurec_sim.report.comparison_sections import SHOWN, differences, points_cell, rank_agreement, rank_cell
from nurec_sim.report.rollout_card import dot
from nurec_sim.report.template import html_page
from nurec_sim.study.results import RANKED_BY, StudyResults
from nurec_sim.study.rollout_sections import (
    braking_section,
    doubt_section,
    failures_section,
    families_section,
    road_section,
    scenes_section,
)

ENOUGH_SCENES = 10
"""Below this the report warns: the percentile bootstrap undercovers with few clusters."""


def render_study(results: StudyResults) -> str:
    """The whole report as one HTML text. The same results give the same text."""
    figures = {f"bars-{metric}": comparison_bars(results.comparison, metric) for metric in BARS}
    body = [
        _header(results), _verdict(results), _bars(results), rank_agreement(results.comparison), _seeing(results),
        _controls(results), doubt_section(results), braking_section(results), differences(results.comparison),
        road_section(results), families_section(results), scenes_section(results), _pairs(results),
        failures_section(results),
    ]  # fmt: skip
    return html_page(f"{results.config.name} · nurec_sim study", body, stored={"figures": figures, "images": {}})


def _header(results: StudyResults) -> str:
    config, failed = results.config, results.failed
    counts = [
        count_of(len(config.scenes), "scene"), count_of(len(config.all_worlds), "world"),
        count_of(len(config.policies), "policy", "policies"), count_of(config.trials, "trial"),
        count_of(config.rollouts, "rollout"),
    ]  # fmt: skip
    tag = f'<span class="tag bad">{failed} failed</span>' if failed else '<span class="tag good">none failed</span>'
    return (
        f"<h1>Does a reconstruction rank policies as the true world does?</h1>"
        f'<p class="soft">study {escape(config.name)} · procedural towns · same starts, actors and random numbers '
        f"in all worlds · off-road by {escape(results.comparison.road)}</p><p>{' · '.join(counts)}{tag}</p>"
    )


def _verdict(results: StudyResults) -> str:
    items = []
    for world in results.config.worlds[1:]:
        found = results.comparison.agreements.get((RANKED_BY[0], world))
        if found is None:
            items.append(f"<b>{escape(world)}</b>: nothing to compare")
            continue
        pairs = found.pairs
        flips = f'<span class="bad">{pairs.opposite} flipped</span>' if pairs.opposite else "none flipped"
        items.append(
            f"<b>{escape(world)}</b> ranks {count_of(len(found.policies), 'policy', 'policies')} with tau-b "
            f"{_interval(found.tau_b)} to the truth by {SHOWN[RANKED_BY[0]]}; of the pairs that both resolve, "
            f"{pairs.same} in the same order, {flips}"
        )
    ceiling = results.comparison.ceilings.get(RANKED_BY[0])
    if ceiling is None:
        items.append("The noise ceiling is unknown: it needs two trials.")
    else:
        items.append(
            f"Noise ceiling: the truth agrees with itself, odd against even trials, with tau-b "
            f"{_interval(ceiling.tau_b)}; a reconstruction above that owes it to sharing the random numbers."
        )
    scenes = len(results.config.scenes)
    if scenes < ENOUGH_SCENES:
        items.append(
            f'<span class="bad">Only {count_of(scenes, "scene")}</span>: bootstrap intervals over fewer than '
            f"{ENOUGH_SCENES} are too narrow to rely on, and so are the tests below."
        )
    items.append(_discrimination(results))
    if results.differing:
        items.append(
            f'<span class="bad">Policies that see nothing rendered did not drive the same in all worlds: '
            f"{escape(', '.join(results.differing))}.</span> This is a fault of the simulator: do not use the results."
        )
    else:
        items.append('<span class="good">Policies that see nothing rendered drove the same in all worlds</span>.')
    return f'<h2>In short</h2><div class="card"><ul>{list_items(items)}</ul></div>'


def _discrimination(results: StudyResults) -> str:
    if results.discriminates is None:
        return "Without corrupted reconstructions as controls it is not known whether this study can discriminate."
    if results.discriminates:
        return '<span class="good">The study discriminates</span>: a corrupted reconstruction ranks policies worse.'
    return (
        '<span class="bad">This study cannot discriminate</span>: corrupted reconstructions rank the policies as well '
        "as the intact one, or the scenes are too few to tell. Agreement above shows nothing about the reconstructions."
    )


def _interval(estimate: Estimate) -> str:
    if estimate.value != estimate.value:
        return "unknown (all policies tied)"
    if estimate.low is None:
        return f"{estimate.value:.2f} (one scene: no interval)"
    return f"{estimate.value:.2f} [{estimate.low:.2f}, {estimate.high:.2f}]"


def _bars(results: StudyResults) -> str:
    panels = "".join(
        f'<div><h3>{escape(title)}</h3><div class="plot" id="bars-{metric}"></div></div>'
        for metric, title in BARS.items()
    )
    legend = ", ".join(f"{dot(place)}<b>{escape(name)}</b>" for place, name in enumerate(results.comparison.worlds))
    return (
        f'<h2>Policies</h2><div class="card"><p>{legend}</p><div class="panels">{panels}</div><p class="key">'
        f"Whiskers: {100 * CONFIDENCE:.0f} % bootstrap intervals over scenes. Collision and off-road: share of "
        "rollouts, lower is better. A rollout is judged up to its first collision or off-road state.</p></div>"
    )


def _seeing(results: StudyResults) -> str:
    rows = []
    for (metric, world), found in results.seeing.items():
        place = results.comparison.worlds.index(world)
        rows.append(
            f"<tr><td>{escape(SHOWN[metric])}<small>{dot(place)}{escape(world)}</small></td>"
            f'<td class="n">{rank_cell(found.tau_b)}</td><td class="n">{100 * found.mmrv:.1f}</td>'
            f'<td class="n">{found.pairs.same}</td><td class="n">{found.pairs.opposite}</td></tr>'
        )
    if not rows:
        return ""
    return (
        '<h3>Only policies that look at a sensor</h3><div class="card scroll"><table><thead><tr><th>Metric</th>'
        '<th class="n">tau-b</th><th class="n">MMRV, points</th><th class="n">same order, resolved</th>'
        f'<th class="n">flipped, resolved</th></tr></thead><tbody>{"".join(rows)}</tbody></table><p class="key">'
        f"{escape(', '.join(results.seeing_policies))}. The others see nothing rendered, agree by construction, and "
        "flatter the table above.</p></div>"
    )


def _controls(results: StudyResults) -> str:
    if not results.drops:
        return ""
    rows = []
    for how in results.config.controls.how:
        cells = "".join(f'<td class="n">{_drop_cell(results.drops.get((how, metric)))}</td>' for metric in RANKED_BY)
        rows.append(f"<tr><td><b>{escape(how)}</b></td>{cells}</tr>")
    heads = "".join(f'<th class="n">{escape(SHOWN[metric])}</th>' for metric in RANKED_BY)
    of = escape(results.config.controls.of)
    return (
        f'<h2>Can the study tell a bad reconstruction?</h2><div class="card scroll"><p>{_discrimination(results)}</p>'
        f"<table><thead><tr><th>Corrupted copy of {of}</th>{heads}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
        f'<p class="key">By how much tau-b to the truth is below that of the intact {of}, with its paired interval. A '
        "world in which all policies are tied counts as tau-b 0.</p></div>"
    )


def _drop_cell(drop: Estimate | None) -> str:
    if drop is None:
        return '<span class="none">unknown</span>'
    judged = "lower" if drop.resolved and drop.value > 0 else "not resolved" if not drop.resolved else "higher"
    return f"{rank_cell(drop)}<small>{judged}</small>"


def _pairs(results: StudyResults) -> str:
    """Every two policies in every world, with adjusted p-values."""
    worlds = [world for world in results.config.worlds if world in results.pairs]
    if not worlds:
        return ""
    found = {world: {(a, b): difference for a, b, difference in results.pairs[world]} for world in worlds}
    rows = []
    for first, second in found[worlds[0]]:
        cells = ""
        for world in worlds:
            difference = found[world].get((first, second))
            if difference is None:
                cells += '<td class="n"><span class="none">unknown</span></td>'
                continue
            p = "" if difference.p_differs is None else f"<small>p {difference.p_differs:.2g}</small>"
            cells += f'<td class="n">{points_cell(difference.estimate)}{p}</td>'
        rows.append(f"<tr><td>{escape(first)} - {escape(second)}</td>{cells}</tr>")
    heads = "".join(f'<th class="n">{escape(world)}</th>' for world in worlds)
    return (
        f'<h2>Pairs of policies</h2><details class="card"><summary>Difference of every two policies in '
        f'{SHOWN[RANKED_BY[0]]}</summary><div class="scroll"><table><thead><tr><th>Pair</th>{heads}</tr></thead>'
        f'<tbody>{"".join(rows)}</tbody></table></div><p class="key">Percentage points, intervals over scenes; p '
        "adjusted for the number of pairs (Holm).</p></details>"
    )
