"""The page around the figures: one HTML file that carries its style, its scripts and its data, and loads nothing."""

from html import escape
from typing import Any

import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from flytune.report.style import FONT

# Nothing may be fetched, from anywhere: what is inline is all there is. Three-dimensional figures use blobs for canvas.
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:"
)

CSS = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
html { scroll-behavior: smooth; }
body { margin: 0; background: #fff; color: #1f2933; font: 16px/1.55 FONT; }
main { max-width: 1100px; margin: 0 auto; padding: 32px 24px 72px; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 4px; letter-spacing: -0.01em; overflow-wrap: anywhere; }
h2 { font-size: 1.5rem; line-height: 1.25; margin: 56px 0 4px; padding-top: 24px; border-top: 2px solid #1f2933;
     overflow-wrap: anywhere; }
h3 { font-size: 1.1rem; margin: 36px 0 6px; }
p { margin: 6px 0 12px; max-width: 78ch; }
.quiet, figcaption, .empty { color: #52606d; }
.lead { font-size: 1.12rem; max-width: none; }
a { color: #0b5fa5; text-decoration-thickness: 1px; text-underline-offset: 2px; }
nav { display: flex; flex-wrap: wrap; gap: 4px 18px; margin: 12px 0 4px; font-size: 0.93rem; }
nav ol { margin: 0; padding-left: 1.4em; overflow-wrap: anywhere; }
.wide { overflow-x: auto; margin: 12px 0; }
table { border-collapse: collapse; width: 100%; font-size: 0.93rem; font-variant-numeric: tabular-nums; }
thead th { font-weight: 600; border-bottom: 1px solid #cbd2d9; padding: 3px 10px; text-align: right; line-height: 1.3; }
thead th[colspan] { text-align: center; }
thead tr:first-child th:first-child { text-align: left; padding-left: 0; }
thead tr + tr th { font-weight: 400; color: #52606d; text-align: right; }
tbody th, tbody td { padding: 5px 10px; border-bottom: 1px solid #e4e7eb; text-align: right; white-space: nowrap; }
tbody th { text-align: left; padding-left: 0; font-weight: 600; }
.words th, .words td { white-space: normal; text-align: left; vertical-align: top; padding-left: 0; }
table.dense { font-size: 0.87rem; }
table.dense th, table.dense td { padding-left: 5px; padding-right: 5px; }
table.dense tbody th { white-space: normal; overflow-wrap: anywhere; min-width: 9rem; padding-left: 0; }
table.narrow { width: auto; }
details { margin: 6px 0 12px; }
summary { cursor: pointer; font-weight: 600; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 3px 20px; margin: 14px 0; font-size: 0.93rem; }
dt { color: #52606d; }
dd { margin: 0; overflow-wrap: anywhere; font-variant-numeric: tabular-nums; }
figure { margin: 10px 0 6px; }
figcaption { font-size: 0.93rem; max-width: 88ch; margin-top: 4px; }
.figure { overflow-x: auto; overflow-y: hidden; }
.figure > div { min-width: 860px; }
.empty { border-left: 3px solid #cbd2d9; padding: 6px 14px; }
code, pre { font-family: ui-monospace, SFMono-Regular, Menlo, Consolas, 'DejaVu Sans Mono', monospace; }
pre { font-size: 0.8rem; line-height: 1.5; background: #f7f8f9; border: 1px solid #e4e7eb; border-radius: 4px;
      padding: 14px 16px; max-height: 560px; overflow: auto; }
pre i { color: #7b8794; font-style: normal; }
@media (max-width: 640px) {
  main { padding: 20px 14px 48px; }
  dl { grid-template-columns: 1fr; gap: 0; }
  dd { margin-bottom: 8px; }
}
@media print {
  main { max-width: none; padding: 0; }
  nav { display: none; }
  .figure, .wide { overflow: visible; }
  .figure > div { zoom: 0.65; }  /* figures keep the width of the window they were drawn in; paper is narrower */
  table, table.dense { font-size: 0.72rem; }
  pre { max-height: none; overflow: visible; white-space: pre-wrap; border: 0; padding: 0; font-size: 0.66rem; }
  figure, table, dl { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
}
""".replace("FONT", FONT)

# Figures are drawn when they come near the window: a page of many policies opens at once. Browsers keep only about a
# dozen WebGL contexts, so figures in space are given back when they are far away again.
SCRIPT = """
const config = {
  responsive: true, displaylogo: false, scrollZoom: false,
  showSendToCloud: false,  // plotly.js offers an upload of the figure to its maker's server
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "resetCameraLastSave3d"],
};
const plots = document.querySelectorAll(".figure > div");
const draw = plot => {
  if (plot.dataset.drawn) return;
  plot.dataset.drawn = "yes";
  const figure = JSON.parse(plot.parentElement.querySelector("script").textContent);
  Plotly.newPlot(plot, figure.data, figure.layout, config);
};
const clear = plot => {
  if (!plot.dataset.drawn || plot.dataset.space !== "yes") return;
  delete plot.dataset.drawn;
  Plotly.purge(plot);
};
const watcher = new IntersectionObserver(
  seen => seen.forEach(entry => (entry.isIntersecting ? draw : clear)(entry.target)), {rootMargin: "800px"});
plots.forEach(plot => watcher.observe(plot));
addEventListener("beforeprint", () => plots.forEach(draw));
"""


def page(title: str, body: str) -> str:
    """The whole page; `title` is text, `body` is HTML."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n"
        f"<script>{get_plotlyjs()}</script>\n<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )


def drawing(plot: go.Figure | str, caption: str) -> str:
    """A figure with what to look at (HTML) beneath it, or the sentence (text) that says why there is none."""
    if isinstance(plot, str):
        return f'<p class="empty">{escape(plot)}</p>'
    height: Any = plot.layout.height  # pyright: ignore[reportAttributeAccessIssue]
    space = "yes" if any(trace.type == "scatter3d" for trace in plot.data) else "no"
    return (
        f'<figure><div class="figure"><div style="height:{height}px" data-space="{space}"></div>'
        f'<script type="application/json">{_data(plot)}</script></div>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _data(plot: go.Figure) -> str:
    """The figure as JSON in which no text can end the script element, or begin a comment or another script."""
    text = plot.to_json(validate=False) or ""
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
