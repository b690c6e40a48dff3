"""A comparison as one page of HTML that needs nothing else."""

import io
from datetime import UTC, datetime
from html import escape
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ewif_jax.lab import tables

if TYPE_CHECKING:
    from ewif_jax.lab.comparison import Comparison

STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:70em;margin:2em auto;padding:0 1em;color:#111}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;margin:.5em 0 1.5em}
th,td{padding:.25em .8em;text-align:right;border-bottom:1px solid #ddd;white-space:nowrap}
th{cursor:pointer;border-bottom:2px solid #555}th:after{content:" \\2195";color:#999}
td:first-child,th:first-child,td.word,th.word{text-align:left}
tr:hover td{background:#f3f6f9}svg{max-width:100%;height:auto}div.wide{overflow-x:auto}
details{margin:1em 0}
"""

# Sorts by the numbers behind the cells; a second click turns the order round.
SCRIPT = """
document.querySelectorAll("table.sortable th").forEach(function(th){
 th.addEventListener("click",function(){
  var body=th.closest("table").tBodies[0],k=th.cellIndex,up=th.dataset.up!=="1";
  th.dataset.up=up?"1":"0";
  var rows=Array.from(body.rows);
  rows.sort(function(a,b){
   var x=a.cells[k].dataset.sort,y=b.cells[k].dataset.sort,u=parseFloat(x),v=parseFloat(y);
   var d=isNaN(u)||isNaN(v)?x.localeCompare(y):u-v;
   return up?d:-d;});
  rows.forEach(function(r){body.appendChild(r);});});});
"""


def page(comparison: "Comparison", reference: str, title: str) -> str:
    """The whole page."""
    title = title or "Comparison of " + ", ".join(comparison.methods)
    table = comparison.table(reference, details=True)
    parts = [f"<h1>{escape(title)}</h1>", f"<p>{escape(tables._table_head(comparison))}</p>"]
    for metric in comparison.design.metrics:
        own = table[table["metric"] == metric]
        heading = f"{metric.replace('_', ' ')}, against {reference} on the same runs"
        parts += [f"<h2>{escape(heading)}</h2>", sortable(own)]
    parts += [
        f"<figure>{svg(figure)}</figure>" for figure in _report_figures(comparison, reference)
    ]
    if len(comparison.tuned):
        parts += ["<h2>Tuned parameters</h2>", _plain_table(comparison.tuned)]
    parts += ["<h2>Cost</h2>", _plain_table(comparison.cost)]
    about = {**comparison.about, "written": datetime.now(UTC).isoformat(timespec="seconds")}
    lines = "".join(
        f"<tr><td>{escape(str(k))}</td><td class='word'>{escape(str(v))}</td></tr>"
        for k, v in about.items()
    )
    parts += [f"<details><summary>Settings and versions</summary><table>{lines}</table></details>"]
    return (
        "<!DOCTYPE html>\n<html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width'><link rel='icon' href='data:,'>"
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>"
        f"{''.join(parts)}<script>{SCRIPT}</script></body></html>\n"
    )


def _report_figures(comparison: "Comparison", reference: str) -> list[Figure]:
    found = []
    for metric in comparison.design.metrics:
        for x in comparison.design.axes:
            if len(comparison.design.axes[x]) > 1:
                found.append(comparison.plot(x, metric))
        if comparison.design.over_time:
            found.append(comparison.plot("time", metric))
        found.append(comparison.pareto("seconds", metric))
    return found


def svg(figure: Figure) -> str:
    """A figure as an SVG element; the same bytes for the same picture."""
    buffer = io.StringIO()
    settings: Any = {"svg.hashsalt": "ewif_jax", "svg.fonttype": "none"}
    with mpl.rc_context(settings):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def sortable(table: Any) -> str:
    """A table whose columns are sorted by a click, by their numbers."""
    seen = tables.for_people(table)
    raw = table.rename(columns=lambda c: c.replace("_", " "))
    head = "".join(f"<th{_column_word(raw[c])}>{escape(c)}</th>" for c in seen.columns)
    rows = []
    for (_, cells), (_, numbers) in zip(seen.iterrows(), raw.iterrows(), strict=True):
        row = "".join(
            f"<td{_column_word(raw[c])} data-sort='{escape(str(numbers[c]))}'>"
            f"{escape(_cell_text(cells[c]))}</td>"
            for c in seen.columns
        )
        rows.append(f"<tr>{row}</tr>")
    body = "".join(rows)
    whole = f"<table class='sortable'><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f"<div class='wide'>{whole}</div>"


def _column_word(column: Any) -> str:
    return " class='word'" if column.dtype.kind not in "iufb" and column.name == "method" else ""


def _cell_text(x: object) -> str:
    return f"{x:.4g}" if isinstance(x, float | np.floating) else str(x)


def _plain_table(frame: pd.DataFrame) -> str:
    head = "".join(f"<th>{escape(str(c).replace('_', ' '))}</th>" for c in frame.columns)
    rows = "".join(
        "<tr>"
        + "".join(f"<td data-sort='{escape(str(x))}'>{escape(_cell_text(x))}</td>" for x in row)
        + "</tr>"
        for row in frame.itertuples(index=False)
    )
    whole = f"<table class='sortable'><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
    return f"<div class='wide'>{whole}</div>"
