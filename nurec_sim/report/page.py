"""The report's HTML: headline, unknowns, failures, and every rollout."""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from nurec_sim.metrics.aggregate import CENSOR_M, DERIVED, MAX_UNKNOWN_FRAC
from nurec_sim.metrics.collision import AT_FAULT_RULE
from nurec_sim.metrics.series import METRICS
from nurec_sim.report.cells import by_policy, count_of, escape, fact_list, full_name, list_items, meaning, summary_cell
from nurec_sim.report.charts import BARS, collision_bars, comparison_bars, time_view
from nurec_sim.report.comparison_sections import fidelity, rank_agreement, what_differs
from nurec_sim.report.data import ReportScene, RunReport
from nurec_sim.report.events import changed_by_seed, grouped
from nurec_sim.report.plan import PlanAxes, plan_view
from nurec_sim.report.rollout_card import rollout_card
from nurec_sim.report.template import html_page
from nurec_sim.report.trust import trust

MAX_EMBEDDED_BYTES = 40_000_000
OFTEN_WITHOUT_VALUE = (
    "time_to_first_event_s",
    "time_to_first_brake_s",
    "collision_delta_v_mps",
    "support",
    "support_least",
)
"""Metrics without a value where there was no event or contact, or the policy has no camera."""
HEADLINE = {
    "collision_any": "Collision C",
    "offroad": "Off-road O",
    "collision_offroad_mean": "(C+O)/2",
    "collision_at_fault": "At fault",
    "offroad_unknown_frac": "Road unknown",
    "progress": "Progress",
    "scene_score": "Scene score",
    "min_distance_to_obstacle_m": "Least gap",
    "comfort": "Comfortable",
}


def render_report(report: RunReport) -> str:
    """The whole report as one HTML text. The same report gives the same text."""
    figures: dict[str, object] = {"collisions": collision_bars(report.summary)}
    images: dict[str, object] = {}
    comparison = report.comparison
    worlds = comparison.worlds if comparison is not None else ()
    groups = grouped(report.rollouts, worlds)
    changing = changed_by_seed(report.rollouts)
    embed = _video_bytes(report) < MAX_EMBEDDED_BYTES
    scenes = {(scene.id, scene.reconstruction): scene for scene in report.scenes}
    views: dict[tuple[str, str], PlanAxes] = {}
    cards = []
    for index, group in enumerate(groups):
        first = group[0].rollout
        key = (first.scene_id, first.reconstruction)
        scene = scenes.get(key, ReportScene(*key))
        if any(entry.rollout.states for entry in group):
            view = views.setdefault(key, PlanAxes(first.recorded))
            image_key = "/".join(key) if scene.grid is not None else None
            if scene.grid is not None and image_key not in images:
                images["/".join(key)] = view.grid_image(scene.grid)
            driven = [entry for entry in group if entry.rollout.states]
            figures[f"plan{index}"] = plan_view(driven, view, image_key, scene.road_map)
            figures[f"time{index}"] = time_view(driven)
        cards.append(rollout_card(index, group, scene, report, changing, embed))
    opening = []
    if comparison is not None:
        figures |= {f"bars-{metric}": comparison_bars(comparison, metric) for metric in BARS}
        opening = [
            what_differs(report, comparison, groups), rank_agreement(comparison), fidelity(report.scenes, worlds)
        ]  # fmt: skip
    rollouts = [
        "<h2>Rollouts</h2>",
        f'<p class="soft">{"The most different" if comparison else "The worst"} first. Click one to open it. In top '
        "views the recorded drive goes to the right.</p>",
        *cards,
        trust(report.rollouts, worlds or sorted({entry.rollout.reconstruction for entry in report.rollouts})),
    ]
    tables = [_headline(report), _collisions(), _unknown(report), _failures(report)]
    body = [
        _header(report),
        *(opening + rollouts + tables if comparison is not None else tables + rollouts),
        _all_metrics(report.summary),
        _reconstructions(report.scenes),
        _definitions(report),
        _versions(report),
    ]
    return html_page(f"{report.title} · nurec_sim", body, stored={"figures": figures, "images": images})


def _video_bytes(report: RunReport) -> int:
    """Bytes of all videos; those of a recorded drive appear once per policy and seed."""
    policies = max(1, len({(entry.rollout.policy, entry.rollout.seed) for entry in report.rollouts}))
    recorded = {video.path for scene in report.scenes for video in scene.recorded}
    own = sum(video.path.stat().st_size for entry in report.rollouts for video in entry.videos)
    return own + policies * sum(path.stat().st_size for path in recorded)


def _header(report: RunReport) -> str:
    rollouts = [entry.rollout for entry in report.rollouts]
    failed = sum(rollout.status != "ok" for rollout in rollouts)
    counts = [
        count_of(len({r.scene_id for r in rollouts}), "scene"),
        count_of(len({r.reconstruction for r in rollouts}), "reconstruction"),
        count_of(len({r.policy for r in rollouts}), "policy", "policies"),
        count_of(len({r.seed for r in rollouts}), "seed"),
        count_of(len(rollouts), "rollout"),
    ]
    scenarios = ", ".join(sorted({rollout.scenario for rollout in rollouts}))
    tag = f'<span class="tag bad">{failed} failed</span>' if failed else '<span class="tag good">none failed</span>'
    return (
        f'<h1>Closed-loop report</h1><p class="soft">{escape(report.title)} · scenario {escape(scenarios)} · '
        f"traffic: log replay · profile {escape(report.profile)}</p><p>{' · '.join(counts)}{tag}</p>"
    )


def _headline(report: RunReport) -> str:
    heads = "".join(
        f'<th class="n" title="{escape(meaning(name))}">{escape(text)}</th>' for name, text in HEADLINE.items()
    )
    many = report.summary["reconstruction"].n_unique() > 1
    title = "Headline" if report.comparison is None else "Headline, each by its own road"
    rows = []
    for (reconstruction, policy), cells in by_policy(report.summary):
        first = next(iter(cells.values()))
        failed = f'<small class="bad">{first["n_failed"]} failed</small>' if first["n_failed"] else ""
        where = f"<small>{escape(reconstruction)}</small>" if many else ""
        values = "".join(summary_cell(cells[name]) for name in HEADLINE)
        rows.append(f'<tr><td><b>{escape(policy)}</b>{where}</td><td class="n">{first["n"]}{failed}</td>{values}</tr>')
    one_scene = report.values["clipgt_id"].n_unique() < 2
    interval = (
        "No intervals: a single scene does not generalise to others."
        if one_scene
        else "Brackets: 95 % bootstrap interval over scenes, with the same resamples for every policy."
    )
    return (
        f'<h2>{title}</h2><div class="card scroll"><table><thead><tr><th>Policy</th><th class="n">Rollouts</th>'
        f"{heads}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
        f'<p class="key">Below each value: rollouts with a known value, of all. {interval} '
        "A value that cannot be computed is <i>unknown</i>, never 0. A rollout is evaluated up to its first "
        "collision or off-road state, so one event can mask the other.</p>"
    )


def _collisions() -> str:
    return (
        '<h2>Collision classes</h2><div class="card"><div class="plot" id="collisions"></div>'
        '<p class="key">Actors replay the log, so a car that is slower than the log is hit from behind: a slow policy '
        f"shows as <i>rear</i>. At fault: {escape(AT_FAULT_RULE.replace('_', ' '))}.</p></div>"
    )


def _unknown(report: RunReport) -> str:
    """All limitations of this report."""
    items = []
    for scene in report.scenes:
        items += [f"{escape(scene.id)} ({escape(scene.reconstruction)}): {escape(text)}" for text in scene.unknown]
    for (reconstruction, policy), cells in by_policy(report.summary):
        first = next(iter(cells.values()))
        if first["n_failed"] == first["n"]:
            items.append(f"{escape(policy)} ({escape(reconstruction)}): every rollout failed, so there are no metrics")
            continue
        dead = [
            name for name, row in cells.items()
            if row["n_valid"] == 0 and name not in OFTEN_WITHOUT_VALUE
        ]  # fmt: skip
        if dead:
            items.append(f"{escape(policy)} ({escape(reconstruction)}): not computed: {escape(', '.join(dead))}")
        share = cells["offroad_unknown_frac"]["mean"]
        if share is not None and share > 0:
            items.append(
                f"{escape(policy)} ({escape(reconstruction)}): the road under the car was unknown in "
                f"{100 * share:.1f} % of the states; scenes above {100 * MAX_UNKNOWN_FRAC:.0f} % are excluded"
            )
    items += [
        f"{escape(full_name(entry))}: no video: {escape(entry.video_error)}"
        for entry in report.rollouts
        if entry.video_error
    ]
    items.append("Actors replay their recording without reacting to the ego; after a contact they continue through it.")
    return f'<h2>Unknowns</h2><div class="card"><ul>{list_items(items)}</ul></div>'


def _failures(report: RunReport) -> str:
    failed = [entry for entry in report.rollouts if entry.rollout.status != "ok"]
    if not failed:
        return '<h2>Failures</h2><div class="card">No rollout failed.</div>'
    items = [
        f"<h3>{escape(full_name(entry))}</h3><pre>{escape(entry.rollout.error or 'no error text')}</pre>"
        f'<p class="key">{len(entry.rollout.states)} states were driven before. It counts as a rollout, without '
        "metrics.</p>"
        for entry in failed
    ]
    return f'<h2>Failures</h2><div class="card">{"".join(items)}</div>'


def _all_metrics(summary: pl.DataFrame) -> str:
    policies = list(by_policy(summary))
    heads = "".join(f'<th class="n">{escape(policy)}<small>{escape(rec)}</small></th>' for (rec, policy), _ in policies)
    rows = [
        f'<tr><td title="{escape(meaning(name))}">{escape(name)}</td>'
        + "".join(summary_cell(cells[name]) for _, cells in policies)
        + "</tr>"
        for name in (*METRICS, *DERIVED)
    ]
    return (
        '<h2>All metrics</h2><details class="card"><summary>Every metric for every policy</summary><div class="scroll">'
        f"<table><thead><tr><th>Metric</th>{heads}</tr></thead><tbody>{''.join(rows)}</tbody></table></div></details>"
    )


def _reconstructions(scenes: Sequence[ReportScene]) -> str:
    cards = []
    for scene in scenes:
        counts = dict(scene.counts)
        tracks = {"actors": counts.pop("tracks", 0), "unlabelled movers": counts.pop("unlabelled movers", 0)}
        facts: dict[str, object] = {f"{name} Gaussians": f"{count:,}" for name, count in counts.items()}
        facts |= {name: count for name, count in tracks.items() if name == "actors" or count}
        if scene.grid is not None:
            rows, columns = scene.grid.state.shape
            facts["road grid"] = (
                f"{columns * scene.grid.cell_m:.0f} x {rows * scene.grid.cell_m:.0f} m, "
                f"cells of {scene.grid.cell_m:g} m, bandwidth {scene.grid.bandwidth_m:.2f} m"
            )
            facts["driven corridor not labelled road"] = f"{100 * scene.grid.overruled_frac:.1f} %"
        facts |= {key: value for key, value in scene.provenance.items() if key != "unknown"}
        if scene.sha256:
            facts["fingerprint"] = scene.sha256[:16]
        cards.append(
            f'<div class="card"><h3>{escape(scene.id)} · {escape(scene.reconstruction)}</h3>{fact_list(facts)}</div>'
        )
    return f"<h2>Reconstructions</h2>{''.join(cards)}" if cards else ""


def _definitions(report: RunReport) -> str:
    rows = [
        f"<tr><td>{escape(name)}</td><td>{escape(metric.meaning)}</td><td>{escape(metric.unit)}</td><td>{metric.reduce.value}</td></tr>"
        for name, metric in METRICS.items()
    ]
    rows += [
        f"<tr><td>{escape(n)}</td><td>{escape(m)}</td><td>{escape(u)}</td><td></td></tr>"
        for n, (u, m) in DERIVED.items()
    ]
    censoring = (
        f"Rollouts are truncated when the ego is {CENSOR_M:g} m off the recorded path."
        if report.profile == "alpasim"
        else f"Rollouts are not truncated at {CENSOR_M:g} m off the recorded path; censored_4m counts them."
    )
    return (
        '<h2>Definitions</h2><details class="card"><summary>Meaning of each metric</summary>'
        f'<p class="key">{censoring}</p><div class="scroll"><table><thead><tr><th>Metric</th><th>Meaning</th>'
        f"<th>Unit</th><th>Over time</th></tr></thead><tbody>{''.join(rows)}</tbody></table></div></details>"
    )


def _versions(report: RunReport) -> str:
    cards = [fact_list(versions) for versions in report.versions]
    if not cards:
        return ""
    return f'<h2>Versions</h2><details class="card"><summary>Software</summary>{"".join(cards)}</details>'
