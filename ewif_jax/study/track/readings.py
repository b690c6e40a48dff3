"""A file of measurements: which column is what, and whether it can be used."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ewif_jax.study.shared.refusal import Refused
from ewif_jax.study.track.columns import EAST, NORTH, Columns, choose_columns, simple
from ewif_jax.study.track.numbers import decimal_mark, to_numbers
from ewif_jax.study.track.table import Table, is_missing, read_table
from ewif_jax.study.track.times import is_of_day, to_seconds

ABSENT = {"sog": 102.3, "speed": 102.3, "cog": 360.0, "heading": 511.0, "trueheading": 511.0}
"""How AIS says that a speed, course or heading is not available."""
NO_LAT, NO_LON = 91.0, 181.0
YEAR = 3.2e7


class Readings(NamedTuple):
    """The rows of a file, in file order: line (N,) numbers, time and arrival (N,) in seconds, track
    and sensor (N,) names, value (N, m) with NaN where there is none. notes: how the file was read;
    dropped: how many rows or lines were left out, by reason."""

    columns: Columns
    line: np.ndarray
    time: np.ndarray
    arrival: np.ndarray
    track: np.ndarray
    sensor: np.ndarray
    value: np.ndarray
    notes: tuple[str, ...] = ()
    dropped: tuple[tuple[str, int], ...] = ()


def read(
    path: Path,
    *,
    time: str | None = None,
    date: str | None = None,
    arrival: str | None = None,
    track: str | None = None,
    sensor: str | None = None,
    values: Sequence[str] | None = None,
    latlon: Sequence[str] | None = None,
    decimal: str | None = None,
    dates: str | None = None,
) -> Readings:
    """The measurements in `path`; columns that are not named are guessed from common names, and
    `"none"` says that there is none. `decimal` ("." or ",") and `dates` ("day-first" or
    "month-first") are what the file shows, unless given.

    Raises:
        Refused: no such file, an empty one, a column that is not there, a row with more cells than
            the header, a cell that cannot be read, or a file that can be read in two ways; the
            message names the file, the line and the column, and how the columns were chosen.
    """
    table = read_table(path)
    columns = choose_columns(
        table,
        time=time,
        date=date,
        arrival=arrival,
        track=track,
        sensor=sensor,
        values=values,
        latlon=latlon,
    )
    try:
        return _read_columns(table, columns, decimal, dates)
    except Refused as error:
        advice = "" if not columns.guessed else " (--time, --track none, ... choose others.)"
        raise Refused(f"{error}\n{columns}{advice}") from None


def _read_columns(
    table: Table, columns: Columns, decimal: str | None, dates: str | None
) -> Readings:
    cells = {name: table.column(name) for name in columns.values}
    stamps = [name for name in (columns.time, columns.arrival) if name is not None]
    numeric = [*columns.values, *(name for name in stamps if not is_of_day(table.column(name)))]
    mark = decimal_mark(table, numeric, decimal)
    stamp = to_seconds(table, columns.time, decimal=mark, dates=dates, date=columns.date)
    arrived = stamp
    if columns.arrival is not None:
        arrived = to_seconds(table, columns.arrival, decimal=mark, dates=dates)
        apart = float(np.median(np.abs(arrived.seconds - stamp.seconds)))
        if apart > YEAR:
            raise Refused(
                f"{table.path}: columns {columns.time!r} and {columns.arrival!r} are {apart:.3g} s "
                "apart: they are not of one clock"
            )
    notes = [f"Times: {stamp.kind}."]
    if mark == ",":
        notes.append("Numbers: decimal commas.")
    if table.delimiter != ",":
        name = {"\t": "tabs", ";": "semicolons"}.get(table.delimiter, table.delimiter)
        notes.append(f"Cells: between {name}.")
    dropped = dict(table.skipped)
    signs = np.ones((len(table.rows), len(columns.values)))
    if columns.geographic:
        for k, letters in enumerate((NORTH, EAST)):
            cells[columns.values[k]], signs[:, k] = _hemisphere_signs(table, columns, k, letters)
    value = np.column_stack([to_numbers(table, name, mark, cells[name]) for name in columns.values])
    if columns.geographic:
        _check_signs(table, columns, value, signs)
        value = value * signs
    value = _without_absent(table, columns, value, dropped)
    names = np.array(table.column(columns.track) if columns.track else [""] * len(value), object)
    if columns.track is not None:
        names, columns = _track_names(table, columns, names, notes)
    sensors = np.array(
        table.column(columns.sensor) if columns.sensor else [""] * len(value), object
    )
    nameless = np.array([columns.track is not None and is_missing(name) for name in names])
    if nameless.all():
        raise Refused(f"{table.path}: column {columns.track!r} is empty (--track none)")
    if nameless.any():
        dropped["rows without the name of a track"] = int(nameless.sum())
    kept = ~nameless
    return Readings(
        columns,
        np.asarray(table.line)[kept],
        stamp.seconds[kept],
        arrived.seconds[kept],
        names[kept],
        sensors[kept],
        value[kept],
        tuple(notes),
        tuple(dropped.items()),
    )


def _track_names(
    table: Table, columns: Columns, names: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, Columns]:
    """A guessed column that differs in every row numbers the rows, not the tracks."""
    is_guess = "track" in columns.guessed
    if is_guess and len(names) > 2 and len(set(names)) == len(names):
        notes.append(f"Column {columns.track!r} differs in every row: not taken for the track.")
        return np.full(len(names), "", object), columns._replace(track=None)
    return names, columns


def _hemisphere_signs(
    table: Table, columns: Columns, k: int, letters: dict[str, int]
) -> tuple[list[str], np.ndarray]:
    """Cells of degrees without their letter, and the signs (N,) that letters in or beside them say
    (NaN: an unsigned cell without any)."""
    name = columns.values[k]
    cells, signs = list(table.column(name)), np.ones(len(table.rows))
    beside = columns.hemispheres[k] if columns.hemispheres else None
    sides = table.column(beside) if beside else None
    lettered = np.zeros(len(cells), bool)
    for row, cell in enumerate(cells):
        if is_missing(cell):
            continue
        for letter in (cell[:1].lower(), cell[-1:].lower()):
            if letter in letters:
                signs[row] = letters[letter]
                cells[row] = cell.strip("NSEWnsew ").rstrip("\N{DEGREE SIGN} ")
                lettered[row] = True
                break
        if sides is not None:
            side = sides[row].lower()
            if side not in letters:
                raise table.refuse(row, str(beside), f"one of {', '.join(letters)}")
            if lettered[row] and signs[row] != letters[side]:
                raise table.refuse(row, name, f"the hemisphere {sides[row]}", cell)
            signs[row] = letters[side]
    return cells, signs


def _check_signs(table: Table, columns: Columns, value: np.ndarray, signs: np.ndarray) -> None:
    """A minus and a hemisphere would say the same thing twice, or contradict each other."""
    for k, name in enumerate(columns.values):
        beside = columns.hemispheres[k] if columns.hemispheres else None
        letters = [cell.strip("0123456789.,+- ") for cell in table.column(name)]
        for row in np.flatnonzero(value[:, k] < 0):
            if beside is not None or letters[row] or signs[row, k] < 0:
                raise table.refuse(int(row), name, "degrees without a minus beside a hemisphere")


def _without_absent(
    table: Table, columns: Columns, value: np.ndarray, dropped: dict[str, int]
) -> np.ndarray:
    """NaN for what AIS writes where nothing is available; refuses what is not on the earth."""
    value = value.copy()
    absent = np.zeros(value.shape, bool)
    if columns.geographic:
        absent[:, 0] = np.abs(value[:, 0]) == NO_LAT
        west = np.abs(value[:, 1])
        absent[:, 1] = (west == NO_LON) & ~np.any(west[west != NO_LON] > 180)
        for k, (name, bound) in enumerate(zip(columns.values, (90, 360), strict=True)):
            bad = (np.abs(value[:, k]) > bound) & ~absent[:, k]
            if bad.any():
                row = int(np.argmax(bad))
                got = float(value[row, k])
                raise table.refuse(row, name, f"degrees within ±{bound}", got)
    else:
        for k, name in enumerate(columns.values):
            if simple(name) in ABSENT:
                absent[:, k] = value[:, k] == ABSENT[simple(name)]
    if absent.any():
        dropped["values that AIS marks as not available"] = int(absent.any(1).sum())
    value[absent] = np.nan
    return value
