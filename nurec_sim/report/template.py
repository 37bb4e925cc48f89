"""Style and script of the report: light, readable, no network."""

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
dd { margin:0; overflow-wrap:anywhere; }
.columns { columns:2; column-gap:28px; } .columns table { break-inside:avoid; }
.key { font-size:13px; color:var(--soft); margin:4px 0 0; }
@media (max-width:900px) { .pair { grid-template-columns:minmax(0,1fr); } .columns { columns:1; }
  main { padding:14px 10px 40px; } }
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
    Plotly.newPlot(element, figure.data, figure.layout, {responsive: true, displayModeBar: false});
  }
  function drawInside(root) { root.querySelectorAll('.plot').forEach(draw); }
  document.querySelectorAll('details').forEach(function (details) {
    details.addEventListener('toggle', function () { if (details.open) drawInside(details); });
  });
  document.querySelectorAll('.plot').forEach(function (element) {
    const closed = element.closest('details:not([open])');
    if (!closed) draw(element);
  });
})();
"""
