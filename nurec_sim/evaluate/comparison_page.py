"""The report of a comparison: one HTML file with tables, differences, worst frames and a video; needs no network."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

import cv2
import numpy as np

from nurec_sim.evaluate.comparison import Comparison, Picture
from nurec_sim.evaluate.log_tables import Row, side_by_side
from nurec_sim.report.template import html_page

JPEG_QUALITY = 88
MORE_STYLE = (
    "img { max-width:100%; border-radius:6px; display:block; } td.wide { background:var(--bg); font-weight:600; }"
)


def render_comparison(comparison: Comparison) -> str:
    """The report as HTML; the same comparison gives the same text."""
    names = list(comparison.figures)
    cards = "".join(
        f'<div class="card scroll"><h3>{escape(caption)}</h3>{_image(picture, caption)}</div>'
        for caption, picture in comparison.worst
    )
    video = ""
    if comparison.video:
        data = base64.b64encode(comparison.video).decode()
        video = (
            '<h2>Side by side</h2><div class="card"><video controls loop muted playsinline '
            f'src="data:video/mp4;base64,{data}"></video></div>'
        )
    title = " / ".join(names)
    body = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="soft">Reconstructions of the log {escape(comparison.clip)}. Differences are to '
        f"{escape(names[0])}; green is better, red is worse.</p>",
        _table(comparison),
        "<h2>Worst frames</h2><p>Above what was recorded and what each scene shows, below how different they look "
        f"(FLIP: black equal, white most different).</p>{cards}",
        video,
    ]
    return html_page(f"{title} · nurec_sim", body, MORE_STYLE)


def _table(comparison: Comparison) -> str:
    names = list(comparison.figures)
    heads = "".join(f'<th class="n">{escape(name)}</th>' for name in names)
    heads += "".join(f'<th class="n">{escape(name)}: difference</th>' for name in names[1:])
    body, group = [], ""
    for title, name, rows in side_by_side(comparison.figures):
        if title != group:
            body.append(f'<tr><td class="wide" colspan="{2 * len(names)}">{escape(title)}</td></tr>')
            group = title
        cells = "".join(f'<td class="n">{escape(row.text if row else "none")}</td>' for row in rows)
        body.append(f"<tr><td>{escape(name)}</td>{cells}{_differences(rows)}</tr>")
    return (
        f'<div class="card scroll"><table><thead><tr><th>figure</th>{heads}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _differences(rows: Sequence[Row | None]) -> str:
    """Each later scene's figure minus the first one's."""
    first, cells = rows[0], []
    for row in rows[1:]:
        if first is None or row is None or first.value is None or row.value is None:
            cells.append('<td class="n none">none</td>')
            continue
        change = round(row.value - first.value, row.digits)
        good = change * row.better
        shade = " good" if good > 0 else " bad" if good < 0 else ""
        cells.append(f'<td class="n{shade}">{change:+.{row.digits}f}</td>')
    return "".join(cells)


def _image(picture: Picture, caption: str) -> str:
    encoded = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    data = base64.b64encode(encoded[1].tobytes()).decode()
    return f'<img alt="{escape(caption)}" src="data:image/jpeg;base64,{data}">'
