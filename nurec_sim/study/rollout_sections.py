"""Sections of a study's report on rollouts and scenes: doubt, roads, braking, what scenes expose, failures."""

from __future__ import annotations

from collections.abc import Iterator

import polars as pl

from nurec_sim.metrics.aggregate import BRAKES_MPS2
from nurec_sim.report.cells import count_of, escape, list_items, shown
from nurec_sim.report.rollout_card import dot
from nurec_sim.report.support import LOW
from nurec_sim.study.braking import SAME_S
from nurec_sim.study.doubt import LOW_SUPPORT, OTHER_START, OTHER_WORLD
from nurec_sim.study.results import StudyResults

MOST_SCENES = 10


def doubt_section(results: StudyResults) -> str:
    """How often verdicts to doubt are wrong, by why they are doubted; empty if nothing is known."""
    rows = []
    for why, by_world in results.doubts.items():
        for world, found in by_world.items():
            ratio = "too few to say" if found.ratio is None else f"{found.ratio:.1f}"
            shares = [
                f"{wrong} of {count}" + (f"<small>{100 * wrong / count:.0f} %</small>" if count else "")
                for wrong, count in ((found.doubtful_wrong, found.doubtful), (found.others_wrong, found.others))
            ]
            place = results.comparison.worlds.index(world)
            cells = "".join(f'<td class="n">{cell}</td>' for cell in (*shares, ratio))
            rows.append(f"<tr><td><b>{why}</b><small>{dot(place)}{escape(world)}</small></td>{cells}</tr>")
    if not rows:
        return ""
    return (
        '<h2>Which verdicts to doubt</h2><div class="card scroll"><table><thead><tr><th>Doubted because</th>'
        '<th class="n">Wrong of the doubted</th><th class="n">Wrong of all others</th><th class="n">Times as often</th>'
        f'</tr></thead><tbody>{"".join(rows)}</tbody></table><p class="key">Policies that look at a sensor. Wrong: the '
        f"same rollout ends otherwise (collision, off-road) in the true world. {LOW_SUPPORT.capitalize()}: before its "
        f"end the policy got an image of which less than {100 * LOW:.0f} % rests on recorded views. "
        f"{OTHER_START.capitalize()}: another trial in the same reconstruction, from a start slightly elsewhere, ends "
        f"otherwise. {OTHER_WORLD.capitalize()}: the rollout ends otherwise in another reconstruction of the log.</p>"
        "</div>"
    )


def road_section(results: StudyResults) -> str:
    """How the roads of the reconstructions agree with the map; empty if not measured."""
    rows = []
    for world, road in results.roads.items():
        scenes = count_of(road.scenes, "scene") + (f", {road.without_road} without road" if road.without_road else "")
        cells = (
            f"{100 * road.agreement:.1f} %<small>least {100 * road.least:.1f} %</small>",
            f"{100 * road.unknown_frac:.1f} %",
            f"{100 * road.boundary_bias_m:+.0f} cm<small>most {100 * road.worst_bias_m:+.0f} cm</small>",
        )
        place = results.comparison.worlds.index(world)
        name = f"<b>{dot(place)}{escape(world)}</b><small>{scenes}</small>"
        rows.append(f"<tr><td>{name}</td>" + "".join(f'<td class="n">{cell}</td>' for cell in cells) + "</tr>")
    if not rows:
        return ""
    return (
        '<h2>Is the road where the road is?</h2><div class="card scroll"><table><thead><tr><th>Reconstruction</th>'
        '<th class="n">Off-road agrees</th><th class="n">Unknown</th><th class="n">Boundary, median</th></tr></thead>'
        f'<tbody>{"".join(rows)}</tbody></table><p class="key">This study judges by the map. A log without a map is '
        "judged by the road-class Gaussians: here both are compared at cars placed beside the recorded path, where the "
        "Gaussians know. Boundary: positive where the reconstructed road is too wide.</p></div>"
    )


def braking_section(results: StudyResults) -> str:
    """When policies that look at a sensor first brake, against the true world."""
    rows = []
    for (world, policy), found in results.braking.items():
        place = results.comparison.worlds.index(world)
        spread = (
            '<span class="none">none</span>'
            if found.median_s is None or found.worst_s is None
            else f"{found.median_s:.1f}<small>at most {found.worst_s:.1f}</small>"
        )
        counts = (found.both, found.early, found.late, found.missed, found.false, found.neither)
        rows.append(
            f"<tr><td><b>{escape(policy)}</b><small>{dot(place)}{escape(world)}</small></td>"
            f'<td class="n">{spread}</td>' + "".join(f'<td class="n">{count}</td>' for count in counts) + "</tr>"
        )
    if not rows:
        return ""
    heads = "".join(
        f'<th class="n">{head}</th>'
        for head in ("Difference, s", "Brakes in both", "earlier", "later", "only in truth", "only here", "in neither")
    )
    return (
        f'<h2>When policies first brake</h2><div class="card scroll"><table><thead><tr><th>Policy</th>{heads}</tr>'
        f'</thead><tbody>{"".join(rows)}</tbody></table><p class="key">Policies that look at a sensor, by rollout. '
        f"Braking: more than {BRAKES_MPS2:.0f} m/s², before any collision or road departure. Difference: median of "
        f"the absolute difference to the same rollout in the true world; earlier and later: by more than {SAME_S} s."
        "</p></div>"
    )


def families_section(results: StudyResults) -> str:
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


def scenes_section(results: StudyResults) -> str:
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


def failures_section(results: StudyResults) -> str:
    """Failed rollouts and their errors; empty if there are none."""
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
