"""The scores as a CSV, as tables in Markdown, and as a figure."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.lines import Line2D

from ewif_jax.lab import style
from ewif_jax.lab.pieces import write_whole

EXACT = "exact answer"
NEAREST = 1e-3
"""Metres below which distances are drawn as this."""
OWN, FOREIGN = style.COLOURS[0], style.COLOURS[1]


def write(table: pd.DataFrame, about: str, folder: Path) -> None:
    """table.csv, table.md and figure.png, each whole or not there."""
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "table.csv", lambda half: table.to_csv(half, index=False))
    text = f"{about}\n\n{markdown(table)}\n"
    write_whole(folder / "table.md", lambda half: half.write_text(text))
    drawn = figure(table)
    write_whole(folder / "figure.png", lambda half: drawn.savefig(half, dpi=110, format="png"))


def markdown(table: pd.DataFrame) -> str:
    """Four tables, a row for each method: error against the exact answer, error against truth,
    consistency, and cost."""
    parts = [
        ("Distance from the exact answer, m", "off", "off_error"),
        ("Error of the position, m", "rmse", "rmse_error"),
    ]
    blocks = [
        f"**{title}** (± standard error over runs)\n\n{_pivot(table, value, error)}"
        for title, value, error in parts
        if table[value].notna().any()
    ]
    if table["nees"].notna().any():
        title = "**Consistency: mean NEES (ideally 4), and share of arrivals in its 95 % band**"
        blocks.append(f"{title}\n\n{_consistency(table)}")
    cost = _cost(table)
    if cost:
        blocks.append(cost)
    has_note = table["note"].notna() & (table["note"] != "")
    notes = table.loc[has_note, ["method", "note"]].drop_duplicates()
    blocks += [f"{row.method}: {row.note}." for row in notes.itertuples()]
    return "\n\n".join(blocks)


def figure(table: pd.DataFrame):
    """A panel for each stream: how far each method is from the exact answer, with standard errors;
    what is nearer than a millimetre is drawn there."""
    streams = list(dict.fromkeys(table["stream"]))
    names = [name for name in dict.fromkeys(table["method"]) if name != EXACT]
    columns = min(4, len(streams))
    rows = -(-len(streams) // columns)
    size = {"width": 2.7 * columns + 1.6, "height": 0.6 + rows * (0.8 + 0.17 * len(names))}
    drawn, axes = style.canvas(rows, columns, sharey=True, sharex=True, **size)
    places = {name: len(names) - k for k, name in enumerate(names)}
    for ax, stream in zip(axes.ravel(), streams, strict=False):
        _panel(ax, table[table["stream"] == stream], places, stream)
    for ax in axes.ravel()[len(streams) :]:
        ax.set_visible(False)
    for ax in axes[:, 0]:
        ax.set_yticks(list(places.values()), list(places), fontsize="small")
    marks = [
        Line2D([], [], color=colour, marker=mark, linestyle="", label=label)
        for colour, mark, label in ((OWN, "o", "ewif_jax"), (FOREIGN, "D", "other libraries"))
    ]
    title = "At most 1 mm is drawn at the left edge"
    drawn.legend(handles=marks, loc="outside upper left", ncols=2, frameon=False, title=title)
    return drawn


def _panel(ax, rows: pd.DataFrame, places: dict[str, int], title: str) -> None:
    for row in rows.itertuples():
        if row.method == EXACT or not np.isfinite(row.off):
            continue
        colour, mark = (OWN, "o") if row.ours else (FOREIGN, "D")
        x, y = max(row.off, NEAREST), places[row.method]
        reach = min(row.off_error, 0.9 * x) if row.off > NEAREST else 0.0
        bar = {"markersize": 4.5, "linewidth": 1, "clip_on": False}
        ax.errorbar([x], [y], xerr=[reach], fmt=mark, color=colour, **bar)
    ax.set_xscale("log")
    ax.set_xlim(NEAREST, 10)
    ax.set_ylim(0.2, len(places) + 0.8)
    style.label(ax, "distance from the exact answer, m", "", title)


def _pivot(table: pd.DataFrame, value: str, error: str) -> str:
    def cell(row) -> str:
        x, dx = getattr(row, value), getattr(row, error)
        if not np.isfinite(x):
            return "-"
        return "0" if abs(x) < 5e-7 else f"{x:.3f} ± {dx:.3f}" if x < 100 else f"{x:.3g}"

    return _by_stream(table, cell)


def _consistency(table: pd.DataFrame) -> str:
    def cell(row) -> str:
        if not np.isfinite(row.nees):
            return "-"
        return (
            f"{row.nees:.3g} ({row.inside:.0%})"
            if row.nees < 1e4
            else f"> 10,000 ({row.inside:.0%})"
        )

    return _by_stream(table, cell)


def _by_stream(table: pd.DataFrame, cell) -> str:
    """Markdown with a row for each method and a column for each stream."""
    streams = list(dict.fromkeys(table["stream"]))
    found = {(row.method, row.stream): cell(row) for row in table.itertuples()}
    lines = [f"| | {' | '.join(streams)} |", "|---" * (len(streams) + 1) + "|"]
    for name in dict.fromkeys(table["method"]):
        cells = [found.get((name, stream), "-") for stream in streams]
        if set(cells) != {"-"}:
            lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cost(table: pd.DataFrame) -> str:
    """Of the stream on which single arrivals were timed."""
    timed = table[table["ours"] & table["live_us"].notna()]
    if timed.empty:
        return ""
    stream = timed["stream"].iloc[0]
    title = (
        f"**Cost on one track of '{stream}'**: microseconds an arrival takes within a recorded "
        "track (one compiled program) and one at a time from Python; seconds to compile the "
        "former; numbers kept"
    )
    lines = [
        title,
        "",
        "| | recorded, us | live, us | compile, s | numbers |",
        "|---|---|---|---|---|",
    ]

    def shown(x: float, form: str) -> str:
        return format(x, form) if np.isfinite(x) else "-"

    for row in table[table["stream"] == stream].itertuples():
        if np.isfinite(row.live_us):
            cells = (shown(row.batch_us, ".1f"), shown(row.live_us, ".0f"),
                     shown(row.compile_s, ".1f"), shown(row.numbers, ".0f"))  # fmt: skip
            lines.append(f"| {row.method} | {' | '.join(cells)} |")
    return "\n".join(lines)
