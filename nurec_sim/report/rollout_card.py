"""One rollout of the report: video, events, bird's-eye view, curves and metrics, in a collapsible card."""

from __future__ import annotations

import base64

import polars as pl

from nurec_sim.report.cells import escape, list_items, meaning, shown
from nurec_sim.report.data import ReportRollout, RunReport
from nurec_sim.types import Rollout

OPEN_ROLLOUTS = 1


def rollout_card(index: int, entry: ReportRollout, report: RunReport, embed: bool) -> str:
    """The HTML card of one rollout; figures ``plan<index>`` and ``time<index>`` are rendered when it is opened.

    Args:
        index: position in the report; the first card is open.
        entry: the rollout with its metrics, contacts, video and scenario.
        report: the whole report, for the metric values.
        embed: whether the video is embedded as base64 instead of linked.
    """
    rollout = entry.rollout
    summary = (
        f"<summary>{escape(rollout.policy)} <span class='where'>· {escape(rollout.scene_id)} · "
        f"{escape(rollout.reconstruction)} · seed {rollout.seed}</span>{_tags(entry)}</summary>"
    )
    parts = []
    if rollout.status != "ok":
        parts.append(f"<pre>{escape(rollout.error)}</pre>")
    if rollout.states:
        parts.append(
            f'<div class="pair"><div>{_video(entry, embed)}{_events(entry)}</div>'
            f'<div><div class="plot" id="time{index}"></div>'
            '<p class="key">Dotted line: the policy takes over. Red line: contact. Red shade: off-road. '
            "Grey shade: road unknown.</p></div></div>"
            f'<div class="plot" id="plan{index}"></div>'
            '<p class="key">Blue: ego, each second. Dashed: recorded path. Brown: moving actors, each second. '
            "Grey boxes: static actors. Red box: ego at the first event.</p>"
        )
    else:
        parts.append('<p class="none">No states.</p>')
    parts.append(_value_table(rollout, report.values))
    if entry.scenario:
        parts.append(f"<details><summary class='soft'>scenario</summary><pre>{escape(entry.scenario)}</pre></details>")
    is_open = " open" if index < OPEN_ROLLOUTS else ""
    return f'<details class="card"{is_open}>{summary}{"".join(parts)}</details>'


def _tags(entry: ReportRollout) -> str:
    if entry.rollout.status != "ok":
        return '<span class="tag bad">failed</span>'
    tags = []
    for side in dict.fromkeys(contact.side for contact in entry.contacts):
        tags.append(f'<span class="tag bad">{side} collision</span>')
    offroad = entry.series["offroad"]
    if offroad.value() > 0.5:
        tags.append('<span class="tag bad">off-road</span>')
    elif not offroad.valid.any():
        tags.append('<span class="tag warn">off-road unknown</span>')
    if not entry.series["collision_any"].valid.any():
        tags.append('<span class="tag warn">collisions unknown</span>')
    return "".join(tags) or '<span class="tag good">no event</span>'


def _video(entry: ReportRollout, embed: bool) -> str:
    if entry.video is None:
        return f'<p class="none">No video{": " + escape(entry.video_error) if entry.video_error else ""}.</p>'
    source = escape(entry.video_link)
    if embed:
        source = "data:video/mp4;base64," + base64.b64encode(entry.video.read_bytes()).decode()
    return f'<video controls muted loop playsinline preload="metadata" src="{source}"></video>'


def _events(entry: ReportRollout) -> str:
    start = entry.rollout.states[0].t_us
    rows = [
        (c.t_us, f"{c.side} contact with {c.label or 'actor'} {c.actor}, ego at {c.ego_speed_mps:.1f} m/s, change of "
         f"speed {c.delta_v_mps:.1f} m/s, {'at fault' if c.at_fault else 'not at fault'} ({c.rule.replace('_', ' ')})")
        for c in entry.contacts
    ]  # fmt: skip
    offroad = entry.series["offroad"]
    hits = offroad.t_us[offroad.valid & (offroad.values > 0.5)]
    if len(hits):
        rows.append((int(hits[0]), "off-road"))
    rows += [(event.t_us, f"{event.kind.replace('_', ' ')}: {event.text}") for event in entry.rollout.events]
    items = [f"{(t_us - start) / 1e6:.1f} s: {escape(text)}" for t_us, text in sorted(rows)]
    return f"<h3>Events</h3><ul>{list_items(items)}</ul>" if items else ""


def _value_table(rollout: Rollout, values: pl.DataFrame) -> str:
    mine = values.filter(
        (pl.col("clipgt_id") == rollout.scene_id) & (pl.col("reconstruction") == rollout.reconstruction)
        & (pl.col("policy") == rollout.policy) & (pl.col("seed") == rollout.seed)
    )  # fmt: skip
    rows = [
        f'<tr><td title="{escape(meaning(row["name"]))}">{escape(row["name"])}</td>'
        f'<td class="n">{shown(row["value"], row["unit"])}</td></tr>'
        for row in mine.iter_rows(named=True)
    ]
    return (
        '<details><summary class="soft">all metrics of this rollout</summary>'
        f'<div class="columns"><table><tbody>{"".join(rows)}</tbody></table></div></details>'
    )
