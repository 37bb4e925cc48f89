"""One rollout of the report, in one or several reconstructions: videos, events, curves and metrics in one card."""

from __future__ import annotations

import base64
from collections.abc import Collection, Sequence

import polars as pl

from nurec_sim.report.cells import escape, list_items, meaning, shown
from nurec_sim.report.data import ReportRollout, ReportScene, RunReport, Video
from nurec_sim.report.events import drive_of, farthest_apart, happenings, verdict
from nurec_sim.report.figure import world_colour
from nurec_sim.report.support import low_support

OPEN_ROLLOUTS = 1
SAME_M = 1e-9
Changing = Collection[tuple[str, str, str]]
BAD = ("failed", "front collision", "lateral collision", "rear collision", "off-road")


def rollout_card(
    index: int, group: Sequence[ReportRollout], scene: ReportScene, report: RunReport, changing: Changing, embed: bool
) -> str:
    """The HTML card of one rollout; figures ``plan<index>`` and ``time<index>`` are rendered when it is opened.

    Args:
        index: position in the report; the first card is open.
        group: the rollout in each reconstruction.
        scene: of the first reconstruction, for videos of the recorded drive.
        report: the whole report, for the metric values.
        changing: ``changed_by_seed`` of all rollouts.
        embed: whether videos are embedded as base64 instead of linked.
    """
    rollout, alone = group[0].rollout, len(group) == 1
    where = f"{rollout.scene_id} · {rollout.reconstruction} · " if alone else f"{rollout.scene_id} · "
    worlds = (_world(place, entry, changing) for place, entry in enumerate(group))
    tags = _tags(group[0], changing) if alone else _apart(group) + "".join(worlds)
    summary = (
        f"<summary>{escape(rollout.policy)} <span class='where'>· {escape(where)}seed {rollout.seed}</span>{tags}"
        "</summary>"
    )
    parts = [
        f"<pre>{'' if alone else escape(e.rollout.reconstruction) + ': '}{escape(e.rollout.error)}</pre>"
        for e in group
        if e.rollout.status != "ok"
    ]
    if any(entry.rollout.states for entry in group):
        curves = (
            f'<div class="curves"><div class="plot" id="time{index}"></div><div class="cursor"></div></div>'
            f'<p class="key">{_curve_key(alone)}</p>'
        )
        videos = _videos(group, scene, embed)
        events = _events(group)
        plan = f'<div class="plot" id="plan{index}"></div><p class="key">{_plan_key(alone)}</p>'
        if alone:
            parts.append(
                f'<div class="pair"><div>{videos}{_player(group)}{events}</div><div>{curves}</div></div>{plan}'
            )
        else:
            parts.append(
                f'{videos}{_player(group)}{events}<div class="pair"><div>{curves}</div><div>{plan}</div></div>'
            )
    else:
        parts.append('<p class="none">No states.</p>')
    parts.append(_value_table(group, report.values))
    scenario = group[0].scenario
    if scenario:
        parts.append(f"<details><summary class='soft'>scenario</summary><pre>{escape(scenario)}</pre></details>")
    is_open = " open" if index < OPEN_ROLLOUTS else ""
    return f'<details class="card rollout" id="rollout{index}"{is_open}>{summary}{"".join(parts)}</details>'


def _tags(entry: ReportRollout, changing: Changing) -> str:
    words = verdict(entry)
    tags = [f'<span class="tag {"bad" if word in BAD else "warn"}">{escape(word)}</span>' for word in words]
    doubts = [low_support(entry), "another seed ends differently" if drive_of(entry) in changing else ""]
    shown_doubts = "".join(f'<span class="tag warn">{escape(doubt)}</span>' for doubt in doubts if doubt)
    return ("".join(tags) or '<span class="tag good">no event</span>') + shown_doubts


def _world(place: int, entry: ReportRollout, changing: Changing) -> str:
    return f'<span class="world">{dot(place)}{escape(entry.rollout.reconstruction)}{_tags(entry, changing)}</span>'


def _apart(group: Sequence[ReportRollout]) -> str:
    metres, at_s = farthest_apart(group)
    if metres <= SAME_M:
        return '<span class="tag">drove the same</span>'
    return f'<span class="tag warn">up to {metres:.1f} m apart, at {at_s:.1f} s</span>'


def dot(place: int) -> str:
    """A dot in the colour of a reconstruction, by its place in the comparison."""
    return f'<i class="dot" style="background:{world_colour(place)}"></i>'


def _videos(group: Sequence[ReportRollout], scene: ReportScene, embed: bool) -> str:
    cells = []
    if len(group) > 1 and scene.recorded:
        cells.append(("recorded", scene.recorded, ""))
    for place, entry in enumerate(group):
        name = f"{dot(place)}{escape(entry.rollout.reconstruction)}" if len(group) > 1 else ""
        cells.append((name, entry.videos, entry.video_error))
    if not any(videos or error for _, videos, error in cells):
        return ""
    shown_cells = []
    for name, videos, error in cells:
        pictures = "".join(_video(video, embed) for video in videos)
        missing = f'<p class="none">No video{": " + escape(error) if error else ""}.</p>'
        head = f'<div class="name">{name}</div>' if name else ""
        shown_cells.append(f"<div>{head}{pictures or missing}</div>")
    return f'<div class="videos">{"".join(shown_cells)}</div>'


def _video(video: Video, embed: bool) -> str:
    source = escape(video.link)
    if embed:
        source = "data:video/mp4;base64," + base64.b64encode(video.path.read_bytes()).decode()
    return f'<video muted playsinline preload="auto" src="{source}"></video>'


def _player(group: Sequence[ReportRollout]) -> str:
    rollout = max((entry.rollout for entry in group), key=lambda rollout: len(rollout.states))
    last_s = (rollout.t_us[-1] - rollout.t_us[0]) / 1e6
    start_s = farthest_apart(group)[1]
    return (
        f'<div class="player" data-start="{start_s:.1f}"><button type="button" aria-label="play">&#9654;</button>'
        f'<input type="range" aria-label="time" min="0" max="{last_s:.1f}" step="0.1" value="0"><output>0.0 s</output>'
        "</div>"
    )


def _events(group: Sequence[ReportRollout]) -> str:
    items = []
    for place, entry in enumerate(group):
        if not entry.rollout.states:
            continue
        start = entry.rollout.states[0].t_us
        name = "" if len(group) == 1 else f"{dot(place)}{escape(entry.rollout.reconstruction)}: "
        for event in happenings(entry):
            at_s = (event.t_us - start) / 1e6
            link = f'<a class="seek" href="#" data-t="{at_s:.1f}">{at_s:.1f} s</a>'
            reason = f"<br><small>{escape(event.reason)}</small>" if event.reason else ""
            items.append((event.t_us, f"{link}: {name}{escape(event.text)}{reason}"))
    metres, at_s = farthest_apart(group)
    if metres > SAME_M:
        link = f'<a class="seek" href="#" data-t="{at_s:.1f}">{at_s:.1f} s</a>'
        items.append((group[0].rollout.states[0].t_us + round(1e6 * at_s), f"{link}: farthest apart, {metres:.1f} m"))
    items.sort(key=lambda item: item[0])
    listed = f"<ul>{list_items([item for _, item in items])}</ul>" if items else '<p class="none">None.</p>'
    return f"<h3>Events</h3>{listed}"


def _curve_key(alone: bool) -> str:
    if alone:
        return (
            "Dotted line: the policy takes over. Red line: contact. Red shade: off-road. Grey shade: road unknown. "
            "Click a curve to go to that time."
        )
    return (
        "One colour per reconstruction, dashed: recorded. Dotted line: the policy takes over. Coloured line: first "
        "contact or off-road state. Click a curve to go to that time."
    )


def _plan_key(alone: bool) -> str:
    ego = "Blue: ego, each second." if alone else "One colour per reconstruction: ego, each second."
    first = " Red box: ego at the first event." if alone else " Brown and grey areas: the road of the first."
    return f"{ego} Dashed: recorded path. Brown boxes: moving actors, each second. Grey boxes: static actors.{first}"


def _value_table(group: Sequence[ReportRollout], values: pl.DataFrame) -> str:
    columns = []
    for rollout in (entry.rollout for entry in group):
        mine = values.filter(
            (pl.col("clipgt_id") == rollout.scene_id) & (pl.col("reconstruction") == rollout.reconstruction)
            & (pl.col("policy") == rollout.policy) & (pl.col("seed") == rollout.seed)
        )  # fmt: skip
        columns.append({row["name"]: shown(row["value"], row["unit"]) for row in mine.iter_rows(named=True)})
    names = [f'<th class="n">{escape(entry.rollout.reconstruction)}</th>' for entry in group]
    head = f"<thead><tr><th></th>{''.join(names)}</tr></thead>" if len(group) > 1 else ""
    rows = [
        f'<tr><td title="{escape(meaning(name))}">{escape(name)}</td>'
        + "".join(f'<td class="n">{column.get(name, "")}</td>' for column in columns)
        + "</tr>"
        for name in columns[0]
    ]
    return (
        '<details><summary class="soft">all metrics of this rollout</summary>'
        f'<div class="columns"><table>{head}<tbody>{"".join(rows)}</tbody></table></div></details>'
    )
