"""The report of a study: one HTML file that opens without a server or a network."""

from __future__ import annotations

from collections.abc import Iterator

import polars as pl

from nurec_sim.metrics.agreement import CONFIDENCE, Estimate
from nurec_sim.report.cells import count_of, escape, list_items, shown
from nurec_sim.report.charts import BARS, comparison_bars
from nurec_sim.report.comparison_sections import SHOWN, differences, points_cell, rank_agreement, rank_cell
from nurec_sim.report.rollout_card import dot
from nurec_sim.report.support import LOW
from nurec_sim.report.template import html_page
from nurec_sim.study.results import RANKED_BY, StudyResults

MOST_SCENES = 10
ENOUGH_SCENES = 10
"""Below this the report warns: the percentile bootstrap undercovers with few clusters."""


def render_study(results: StudyResults) -> str:
    """The whole report as one HTML text. The same results give the same text."""
    figures = {f"bars-{metric}": comparison_bars(results.comparison, metric) for metric in BARS}
    body = [
        _header(results), _verdict(results), _bars(results), rank_agreement(results.comparison), _seeing(results),
        _controls(results), _support(results), differences(results.comparison), _families(results), _scenes(results),
        _pairs(results), _failures(results),
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


def _support(results: StudyResults) -> str:
    if not results.doubts:
        return ""
    rows = []
    for world, found in results.doubts.items():
        ratio = "too few to say" if found.ratio is None else f"{found.ratio:.1f} times"
        shares = [
            f"{wrong} of {count}" + (f"<small>{100 * wrong / count:.0f} %</small>" if count else "")
            for wrong, count in ((found.doubtful_wrong, found.doubtful), (found.others_wrong, found.others))
        ]
        cells = "".join(f'<td class="n">{cell}</td>' for cell in (*shares, ratio))
        rows.append(f"<tr><td><b>{escape(world)}</b></td>{cells}</tr>")
    return (
        '<h2>Does low support warn?</h2><div class="card scroll"><table><thead><tr><th>World</th>'
        '<th class="n">Wrong with low support</th><th class="n">Wrong of all others</th><th class="n">How often</th>'
        f'</tr></thead><tbody>{"".join(rows)}</tbody></table><p class="key">Policies with cameras. Wrong: the '
        "same rollout ends otherwise (collision, off-road) in the true world. Low: before its end the policy got an "
        f"image of which less than {100 * LOW:.0f} % rests on recorded views.</p></div>"
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


def _families(results: StudyResults) -> str:
    """What each family of scenes exposes, in the true world."""
    config = results.config
    family = {scene_id: each.name for scene_id, each, _ in config.scenes}
    truth = results.values.filter(
        (pl.col("reconstruction") == config.worlds[0]) & (pl.col("name") == "offroad_or_collision")
    ).with_columns(pl.col("clipgt_id").replace_strict(family).alias("family"))
    means = {
        (row["family"], row["policy"]): row["value"]
        for row in truth.group_by("family", "policy").agg(pl.col("value").mean()).iter_rows(named=True)
    }
    policies = sorted(truth["policy"].unique().to_list())
    heads = "".join(
        f"<th>{escape(each.name)}<br><small>{escape(each.scenario)}</small></th>" for each in config.families
    )
    rows = "".join(
        f"<tr><td><b>{escape(policy)}</b></td>"
        + "".join(f"<td>{shown(means.get((each.name, policy)), 'share')}</td>" for each in config.families)
        + "</tr>"
        for policy in policies
    )
    return (
        f'<h2>What the scenes expose</h2><div class="card scroll"><table><thead><tr><th>Policy</th>{heads}</tr></thead>'
        f'<tbody>{rows}</tbody></table><p class="key">Share of rollouts in the true world that collide or leave the '
        "road. A family in which all policies do alike ranks none.</p></div>"
    )


def _scenes(results: StudyResults) -> str:
    """Scenes by how many verdicts differ from the truth."""
    items = [
        f"<b>{escape(scene)}</b>: {count_of(len(changes), 'rollout')} "
        f"{'ends' if len(changes) == 1 else 'end'} differently: {escape('; '.join(changes[:6]))}"
        + (f" and {len(changes) - 6} more" if len(changes) > 6 else "")
        for scene, changes in _changes(results)
    ]
    if not items:
        return '<h2>Scenes</h2><div class="card">No rollout ends differently in a reconstruction.</div>'
    return f'<h2>Scenes with most disagreement</h2><div class="card"><ul>{list_items(items[:MOST_SCENES])}</ul></div>'


def _changes(results: StudyResults) -> Iterator[tuple[str, list[str]]]:
    worlds = results.config.worlds
    verdicts: dict[tuple[str, str, int], dict[str, str]] = {}
    wanted = results.values.filter(pl.col("name").is_in(["collision_any", "offroad"]) & (pl.col("value") == 1))
    for row in results.values.filter(pl.col("name") == "offroad").iter_rows(named=True):
        verdicts.setdefault((row["clipgt_id"], row["policy"], row["seed"]), {})[row["reconstruction"]] = (
            "no event" if row["status"] == "ok" else "failed"
        )
    for row in wanted.iter_rows(named=True):
        said = "collision" if row["name"] == "collision_any" else "off-road"
        verdicts[row["clipgt_id"], row["policy"], row["seed"]][row["reconstruction"]] = said
    by_scene: dict[str, list[str]] = {}
    for (scene, policy, seed), found in sorted(verdicts.items()):
        for world in worlds[1:]:
            if found[world] != found[worlds[0]]:
                text = f"{policy}, seed {seed}: {found[worlds[0]]} in truth, {found[world]} in {world}"
                by_scene.setdefault(scene, []).append(text)
    return iter(sorted(by_scene.items(), key=lambda item: (-len(item[1]), item[0])))


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


def _failures(results: StudyResults) -> str:
    rows = results.values.filter(pl.col("status") != "ok").unique("rollout_id", keep="first", maintain_order=True)
    if not len(rows):
        return ""
    items = [
        f"{escape(row['policy'])} in {escape(row['clipgt_id'])} ({escape(row['reconstruction'])}), seed {row['seed']}: "
        f"{escape(row['error'])}"
        for row in rows.head(50).iter_rows(named=True)
    ]
    more = [f"and {len(rows) - 50} more"] if len(rows) > 50 else []
    return (
        f'<h2>Failures</h2><div class="card"><p>A failed rollout has no value; its trial is left out for all policies '
        f"and worlds, so that all are compared on the same ones.</p><ul>{list_items([*items, *more])}</ul></div>"
    )
