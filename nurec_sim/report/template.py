"""Frame, style and script of the HTML reports: light, readable, no network."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any

STYLE = """
:root { --ink:#1e293b; --soft:#64748b; --line:#e2e8f0; --bg:#f8fafc; --card:#ffffff; --bad:#b91c1c; --good:#15803d; }
* { box-sizing:border-box; }
body { margin:0; background:var(--bg); color:var(--ink); line-height:1.5; font-size:15px;
  font-family:system-ui,-apple-system,'Segoe UI',Roboto,'DejaVu Sans',sans-serif; }
main { max-width:1240px; margin:0 auto; padding:24px 20px 60px; }
h1 { font-size:26px; margin:0 0 4px; } h2 { font-size:19px; margin:34px 0 10px; }
h3 { font-size:15px; margin:14px 0 6px; }
p { margin:6px 0; max-width:80ch; } .soft { color:var(--soft); } small { color:var(--soft); font-size:12px; }
.card { background:var(--card); border:1px solid var(--line); border-radius:8px; padding:14px 16px; margin:10px 0; }
.scroll { overflow-x:auto; }
table { border-collapse:collapse; width:100%; font-variant-numeric:tabular-nums; }
th { text-align:left; font-weight:600; font-size:13px; color:var(--soft); vertical-align:bottom; }
th, td { padding:7px 7px; border-bottom:1px solid var(--line); } tr:last-child td { border-bottom:0; }
td.n, th.n { text-align:right; white-space:nowrap; } td small { display:block; }
.none { color:var(--soft); font-style:italic; }
.bad { color:var(--bad); font-weight:600; } .good { color:var(--good); }
.tag { display:inline-block; border-radius:999px; padding:1px 9px; font-size:12px; font-weight:600; margin-left:6px;
  background:#e2e8f0; color:#334155; white-space:nowrap; }
.tag.bad { background:#fee2e2; color:#991b1b; } .tag.good { background:#dcfce7; color:#166534; }
.tag.warn { background:#fef3c7; color:#92400e; }
details.card > summary { cursor:pointer; font-weight:600; }
details.card > summary .where { font-weight:400; color:var(--soft); }
.pair { display:grid; grid-template-columns:minmax(0,1fr) minmax(0,1fr); gap:16px; margin-top:12px; align-items:start; }
video { width:100%; border-radius:6px; background:#0f172a; display:block; }
pre { white-space:pre-wrap; overflow-wrap:anywhere; background:#f1f5f9; border-radius:6px;
  padding:8px 10px; font-size:12.5px; margin:6px 0; }
.plot { width:100%; min-height:120px; } #collisions { min-height:0; }
ul { margin:6px 0; padding-left:22px; } li { margin:3px 0; }
dl { display:grid; grid-template-columns:max-content 1fr; gap:3px 16px; margin:8px 0; } dt { color:var(--soft); }
dd { margin:0; overflow-wrap:anywhere; } dd summary { cursor:pointer; }
.columns { columns:2; column-gap:28px; } .columns table { break-inside:avoid; }
.key { font-size:13px; color:var(--soft); margin:4px 0 0; }
.dot { display:inline-block; width:10px; height:10px; border-radius:50%; margin-right:5px; }
.world { display:inline-block; margin-left:10px; font-weight:400; }
.videos { display:grid; grid-template-columns:repeat(auto-fit,minmax(min(280px,45%),1fr)); gap:10px; margin-top:12px; }
.panels { display:grid; grid-template-columns:repeat(auto-fit,minmax(min(320px,100%),1fr)); gap:4px 14px; }
.panels > div, .pair > div { min-width:0; } .panels h3 { margin:10px 0 0; }
.videos .name { font-weight:600; font-size:13px; margin-bottom:3px; } .videos video { margin-bottom:6px; }
.player { display:flex; gap:10px; align-items:center; margin:8px 0; } .player input { flex:1; }
.player button { border:1px solid var(--line); background:#fff; border-radius:6px; padding:4px 12px; cursor:pointer; }
.player output { width:4.5em; text-align:right; font-variant-numeric:tabular-nums; }
.curves { position:relative; } .cursor { position:absolute; top:24px; bottom:42px; width:0; display:none;
  border-left:2px solid #0f172a; pointer-events:none; }
a { color:#1d4ed8; } .card h3:first-child { margin-top:0; }
@media (max-width:900px) { .pair { grid-template-columns:minmax(0,1fr); } .columns { columns:1; }
  main { padding:14px 10px 40px; } }
@media (max-width:600px) { dl { grid-template-columns:fit-content(38%) minmax(0,1fr); } }
@media print { details.card { break-inside:avoid; } }
"""

SCRIPT = """
(function () {
  const store = JSON.parse(document.getElementById('figures').textContent);
  function draw(element) {
    if (element.dataset.drawn || !store.figures[element.id]) return;
    element.dataset.drawn = '1';
    const figure = store.figures[element.id];
    (figure.layout.images || []).forEach(function (image, index) {
      const stored = store.images[image.image_key];
      figure.layout.images[index] = Object.assign({xref: 'x', yref: 'y', xanchor: 'left', yanchor: 'top',
        sizing: 'stretch', layer: 'below'}, stored);
    });
    if (element.clientWidth < 560) figure.layout.showlegend = false;
    if (figure.now) {
      const cars = figure.now.map(function (car) { return car.colour; });
      figure.data.push({type: 'scatter', mode: 'markers', name: 'now', x: [], y: [], hoverinfo: 'skip',
        showlegend: false, marker: {size: 13, color: cars, line: {color: '#0f172a', width: 2}}});
    }
    // Else Plotly, which measures its parent when the window changes, would find none and squash the figure.
    element.style.height = figure.layout.height + 'px';
    Plotly.newPlot(element, figure.data, figure.layout, {responsive: true, displayModeBar: false});
  }
  function drawInside(root) { root.querySelectorAll('.plot').forEach(draw); }
  // One time for a card: its videos, the cursor over its curves, and the cars in its top view.
  function wire(card) {
    const bar = card.querySelector('.player input');
    if (!bar) return;
    const button = card.querySelector('.player button'), clock = card.querySelector('.player output');
    const videos = Array.from(card.querySelectorAll('video')), cursor = card.querySelector('.cursor');
    const last = parseFloat(bar.max);
    let now = 0, playing = false, before = 0;
    function show(seek) {
      bar.value = now;
      clock.textContent = now.toFixed(1) + ' s';
      videos.forEach(function (video) {
        if (seek || Math.abs(video.currentTime - now) > 0.15) video.currentTime = Math.min(now, video.duration || now);
      });
      const curves = card.querySelector('.curves .plot'), plan = card.querySelector('.plot[id^=plan]');
      if (curves && curves._fullLayout && curves._fullLayout.xaxis) {
        const axis = curves._fullLayout.xaxis;
        cursor.style.display = 'block';
        cursor.style.left = (axis._offset + axis.l2p(now)) + 'px';
      }
      const cars = plan && store.figures[plan.id].now;
      if (cars && plan._fullLayout) {
        const index = cars.map(function (car) { return Math.min(Math.round(now * 10), car.x.length - 1); });
        const xs = [cars.map(function (car, k) { return car.x[index[k]]; })];
        const ys = [cars.map(function (car, k) { return car.y[index[k]]; })];
        Plotly.restyle(plan, {x: xs, y: ys}, [plan.data.length - 1]);
      }
    }
    function go(time) { now = Math.max(0, Math.min(last, time)); show(true); }
    function play(wanted) {
      playing = wanted;
      button.innerHTML = playing ? '&#10074;&#10074;' : '&#9654;';
      videos.forEach(function (video) { if (playing) video.play().catch(function () {}); else video.pause(); });
      before = performance.now();
      if (playing) requestAnimationFrame(tick);
    }
    let shown = 0;
    function tick(at) {
      if (!playing) return;
      now += Math.max(0, at - before) / 1000;
      before = at;
      if (now >= last) { play(false); now = last; }
      if (at - shown > 90 || !playing) { shown = at; show(false); }
      if (playing) requestAnimationFrame(tick);
    }
    button.addEventListener('click', function () { if (!playing && now >= last) go(0); play(!playing); });
    bar.addEventListener('input', function () { play(false); go(parseFloat(bar.value)); });
    card.querySelectorAll('a.seek').forEach(function (link) {
      link.addEventListener('click', function (event) {
        event.preventDefault(); play(false); go(parseFloat(link.dataset.t));
        (card.querySelector('.videos') || bar).scrollIntoView({block: 'nearest', behavior: 'smooth'});
      });
    });
    const curves = card.querySelector('.curves .plot');
    if (curves && curves.on) curves.on('plotly_click', function (event) { play(false); go(event.points[0].x); });
    videos.forEach(function (video) { video.addEventListener('loadedmetadata', function () { show(true); }); });
    window.addEventListener('resize', function () { show(false); });
    const first = card.querySelector('a.seek'), apart = parseFloat(card.querySelector('.player').dataset.start);
    go(apart || (first ? parseFloat(first.dataset.t) : 0));
  }
  function openCard(card) {
    drawInside(card);
    if (card.classList.contains('rollout') && !card.dataset.wired) { card.dataset.wired = '1'; wire(card); }
  }
  document.querySelectorAll('a.jump').forEach(function (link) {
    link.addEventListener('click', function () {
      const card = document.querySelector(link.getAttribute('href'));
      if (card) card.open = true;
    });
  });
  document.querySelectorAll('details').forEach(function (details) {
    details.addEventListener('toggle', function () { if (details.open) openCard(details); });
  });
  document.querySelectorAll('.plot').forEach(function (element) {
    const closed = element.closest('details:not([open])');
    if (!closed) draw(element);
  });
  document.querySelectorAll('details[open]').forEach(openCard);
})();
"""


def html_page(
    title: str,
    body: Iterable[str],
    style: str = "",
    stored: Mapping[str, Any] | None = None,
    script: str = SCRIPT,
) -> str:
    """A self-contained page; the same parts give the same text.

    Args:
        title: plain text.
        body: pieces of HTML; empty ones are left out.
        style: CSS after that of all reports.
        stored: JSON values for ``script``, in the element ``figures``; None for a page without plotly and script.
        script: JavaScript that runs at the end, with plotly loaded.
    """
    scripts = ""
    if stored is not None:
        from plotly.offline import get_plotlyjs

        text = json.dumps(stored, separators=(",", ":"), allow_nan=False)
        text = text.replace("<", "\\u003c")  # so that no text can close the script element
        scripts = (
            f'<script type="application/json" id="figures">{text}</script>\n'
            f"<script>{get_plotlyjs()}</script>\n<script>{script}</script>"
        )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}{style}</style></head>\n<body><main>\n"
        + "\n".join(part for part in body if part)
        + f"\n</main>{scripts}</body></html>\n"
    )
