"""A first look at a log as one HTML page: sensors over time, the drive from above, images, and every check."""

from __future__ import annotations

from collections.abc import Sequence

from nurec_sim.logs import SENSOR_COLUMNS, Clip, Measure, describe_clip
from nurec_sim.logs.overlay import CAPTION_PX, draw_camera
from nurec_sim.report.cells import count_of, escape, fact_list, list_items
from nurec_sim.report.log_map import drive_map, image_source, timeline
from nurec_sim.report.template import html_page

MOST_LISTED = 100
SHOWN_AT = (0.1, 0.5, 0.9)
"""When images are shown, as fractions of the log."""
UNDECIDED = ("cannot tell", "not known", "not looked at")
REMEDIES = {
    "ground": "Rig poses must lie on the ground below the rear axle. Correct the height or the tilt of the LiDAR's "
    "mounting pose, or the height of the rig frame.",
    "beams": "Give sweeps as the LiDAR measured them, with the time of each point, and the right beam table. Without "
    "beams, directions without a return are unknown, and another table stands in when the LiDAR is rendered.",
    "LiDAR in camera": "Check the direction of the camera's mounting pose (rig from camera, OpenCV axes), its lens, "
    "and the times of images and sweeps. Where nothing stands out against sky or street this cannot tell: look at the "
    "images below.",
    "cameras": "Check the mounting poses of both cameras and the times of their images: surfaces that both see will be "
    "blurred or doubled.",
    "boxes": "Check the frame of the boxes (centre, x forward), their times, and the LiDAR's mounting pose.",
}
"""What to do about a check, by the beginning of its name."""
MORE_STYLE = """
h1 { overflow-wrap:anywhere; } figure { margin:0; }
svg { width:100%; height:auto; max-height:900px; display:block; } svg text { font-size:13px; fill:#334155; }
.shots { display:grid; grid-template-columns:repeat(auto-fill,minmax(300px,1fr)); gap:10px; }
.shots img { width:100%; border-radius:6px; display:block; }
td.find { min-width:14em; } td.todo { min-width:16em; } table.plain td { white-space:nowrap; }
.swatch { display:inline-block; width:12px; height:12px; border-radius:3px; vertical-align:-1px; margin-right:4px; }
@media (max-width:600px) { svg.wide { min-width:640px; } td.find { min-width:0; } }
"""


def log_page(clip: Clip, faults: Sequence[str], measures: Sequence[Measure]) -> str:
    """The page as one self-contained HTML text.

    Args:
        clip: the log.
        faults: what ``logs.check_clip`` found.
        measures: what ``logs.measure_clip`` found.
    """
    summary = describe_clip(clip)
    number = len(faults) + sum(len(each.faults) for each in measures)
    tag = (
        f'<span class="tag bad">{count_of(number, "fault")}</span>'
        if number
        else '<span class="tag good">no faults</span>'
    )
    lines, gaps = timeline(clip)
    body = [
        f"<h1>{escape(clip.id)}{tag}</h1>",
        f'<p class="soft">A driving log, {escape(clip.format or "in memory")}, as nurec_sim reads it.</p>',
        f'<div class="card">{fact_list({name: value for name, value in summary.facts if name != "clip"})}</div>',
        "<h2>Checks</h2>",
        _checks(measures),
        _faults(faults),
        "<h2>Sensors over time</h2>",
        f'<div class="card scroll">{lines.replace("<svg ", "<svg class=wide ", 1)}</div>',
        f"<ul>{list_items([escape(gap) for gap in gaps[:MOST_LISTED]])}</ul>" if gaps else "",
        f'<div class="card scroll">{_table(SENSOR_COLUMNS, summary.sensors)}</div>',
        "<h2>From above</h2>",
        f'<div class="card">{drive_map(clip)}{_legend()}</div>',
        *_images(clip),
    ]
    return html_page(f"{clip.id} · nurec_sim", body, MORE_STYLE)


def _checks(measures: Sequence[Measure]) -> str:
    if not measures:
        return '<p class="none">Nothing to check: the log has no LiDAR.</p>'
    # Where there is nothing to do, a column for it would only be too wide for a phone.
    idle = not any(each.faults or each.found.startswith(UNDECIDED) for each in measures)
    rows = []
    for each in measures:
        undecided = each.found.startswith(UNDECIDED)
        tag = ("bad", "fault") if each.faults else ("warn", "undecided") if undecided else ("good", "fits")
        todo = ""
        if each.faults or undecided:
            todo = next((text for start, text in REMEDIES.items() if each.what.startswith(start)), "")
        faults = "".join(f'<small class="bad">{escape(fault)}</small>' for fault in each.faults)
        rows.append(
            f'<tr><td>{escape(each.what)}</td><td><span class="tag {tag[0]}">{tag[1]}</span></td>'
            f'<td class="find">{escape(each.found)}{faults}</td>'
            + ("" if idle else f'<td class="todo">{escape(todo)}</td>')
            + "</tr>"
        )
    heads = "".join(f"<th>{text}</th>" for text in ("Check", "", "Found", *(() if idle else ("What to do",))))
    return (
        f'<div class="card scroll"><table><thead><tr>{heads}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
        '<p class="key">LiDAR in camera: how much better depth edges of the LiDAR meet edges of the image than by '
        "chance, for the calibration as given and for the best of those with turned or inverted axes.</p></div>"
    )


def _faults(faults: Sequence[str]) -> str:
    if not faults:
        return "<p>Every image and every sweep was read; none has a fault.</p>"
    listed = [f'<span class="bad">{escape(fault)}</span>' for fault in faults[:MOST_LISTED]]
    more = f"<p>and {len(faults) - MOST_LISTED} more</p>" if len(faults) > MOST_LISTED else ""
    return (
        f'<div class="card"><ul>{list_items(listed)}</ul>{more}'
        '<p class="key">Copy or record these files again, or leave their frames out: nurec-sim trim.</p></div>'
    )


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<table class="plain"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def _legend() -> str:
    colours = (("#0e7490", "LiDAR points that a camera sees"), ("#d97706", "LiDAR points that none sees"),
               ("#1d4ed8", "the car's path, a mark each second"), ("#b45309", "objects that move"),
               ("#94a3b8", "objects that stand"))  # fmt: skip
    return '<p class="key">' + " · ".join(
        f'<span class="swatch" style="background:{colour}"></span>{text}' for colour, text in colours
    ) + "</p>"  # fmt: skip


def _images(clip: Clip) -> list[str]:
    start_us, end_us = clip.span_us
    parts = ["<h2>Images with LiDAR points and boxes</h2>"] if clip.rig.cameras else []
    frames = max((clip.frame_count(name) for name in clip.rig.cameras), default=0)
    for share in SHOWN_AT if frames > len(SHOWN_AT) else (0.5,):
        t_us = start_us + round(share * (end_us - 1 - start_us))
        shots = [_shot(clip, name, t_us) for name in clip.rig.cameras]
        if shots:
            parts.append(f"<h3>{(t_us - start_us) / 1e6:.1f} s</h3><div class='shots'>{''.join(shots)}</div>")
    if parts:
        parts.append('<p class="key">Points are red near and blue far; a cross marks the front of a box.</p>')
    return parts


def _shot(clip: Clip, name: str, t_us: int) -> str:
    image = draw_camera(clip, name, t_us)
    source = image_source(image[CAPTION_PX:], "jpeg", 80)
    return (
        f'<figure><img src="{source}" alt="{escape(name)}"><figcaption class="key">{escape(name)}</figcaption></figure>'
    )
