"""A CSV file of measurements: which column is what, and whether it can be used."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from ewif_jax.study.shared.experiment import Refused

TIMES = ("validity_time", "lastposupdate", "time", "timestamp", "t")
ARRIVALS = ("arrival", "arrival_time", "received", "report_time", "time")
TRACKS = ("track", "track_id", "icao24", "object", "target", "id")
SENSORS = ("sensor", "sensor_id")
LATLON = (("lat", "lon"), ("latitude", "longitude"))
VALUES = (("x", "y", "z"), ("x", "y"), ("east", "north"), ("x",), ("value",))


class Columns(NamedTuple):
    """Names of the columns; None where the file has no such thing."""

    time: str
    arrival: str | None
    track: str | None
    sensor: str | None
    values: tuple[str, ...]
    geographic: bool


class Readings(NamedTuple):
    """The rows of a file, in file order: line (N,) numbers, time and arrival (N,) in seconds, track
    and sensor (N,) names, value (N, m) with NaN where a cell is empty."""

    columns: Columns
    line: np.ndarray
    time: np.ndarray
    arrival: np.ndarray
    track: np.ndarray
    sensor: np.ndarray
    value: np.ndarray


def read(
    path: Path,
    *,
    time: str | None = None,
    arrival: str | None = None,
    track: str | None = None,
    sensor: str | None = None,
    values: list[str] | None = None,
    latlon: list[str] | None = None,
) -> Readings:
    """The measurements in `path`; columns that are not named are guessed from common names.

    Raises:
        Refused: no such file, an empty one, a column that is not there, or a cell that is not a
            finite number where one is needed; the message names the file, the line and the column.
    """
    table: Any = _table(path)
    columns = _columns(path, list(table), time, arrival, track, sensor, values, latlon)
    table = table[(table != "").any(axis=1)]
    if table.empty:
        raise Refused(f"{path}: has a header but no rows")
    stamp = _numbers(path, table, columns.time, needed=True)
    arrived = stamp
    if columns.arrival is not None:
        arrived = _numbers(path, table, columns.arrival, needed=True)
    value = np.column_stack([_numbers(path, table, name) for name in columns.values])
    if columns.geographic:
        _on_earth(path, table, columns, value)
    nothing = pd.Series("", table.index)
    names = table[columns.track] if columns.track else nothing
    sensors = table[columns.sensor] if columns.sensor else nothing
    line = table.index.to_numpy() + 2
    return Readings(columns, line, stamp, arrived, names.to_numpy(), sensors.to_numpy(), value)


def _table(path: Path) -> Any:
    """All cells as stripped text, blank lines kept, so that row i is line i + 2."""
    try:
        table = pd.read_csv(
            path,
            dtype=str,
            keep_default_na=False,
            skip_blank_lines=False,
            index_col=False,
            encoding="utf-8-sig",
        )
    except FileNotFoundError:
        raise Refused(f"{path}: no such file") from None
    except pd.errors.EmptyDataError:
        raise Refused(f"{path}: is empty") from None
    except (pd.errors.ParserError, UnicodeDecodeError) as error:
        raise Refused(f"{path}: is not a CSV file: {error}") from None
    table.columns = table.columns.str.strip()
    return table.fillna("").apply(lambda column: column.str.strip())


def _columns(
    path: Path,
    have: list[str],
    time: str | None,
    arrival: str | None,
    track: str | None,
    sensor: str | None,
    values: list[str] | None,
    latlon: list[str] | None,
) -> Columns:
    lower = {name.lower(): name for name in reversed(have)}

    def find(role: str, given: str | None, guesses: tuple[str, ...], taken: str = "") -> str | None:
        if given is not None:
            if given not in have:
                raise Refused(f"{path}: has no column {given!r} for {role}; {_listed(have)}")
            return given
        found = (lower[guess] for guess in guesses if guess in lower)
        return next((name for name in found if name != taken), None)

    def all_of(role: str, names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(str(find(role, name, ())) for name in names)

    def first(groups: tuple[tuple[str, ...], ...]) -> tuple[str, ...] | None:
        whole = (group for group in groups if all(name in lower for name in group))
        return next((tuple(lower[name] for name in group) for group in whole), None)

    when = find("--time", time, TIMES)
    if when is None:
        raise Refused(f"{path}: say which column is the time (--time); {_listed(have)}")
    if latlon is not None and len(latlon) != 2:
        raise Refused(f"--latlon: expected two columns, got {','.join(latlon)}")
    place = all_of("--latlon", tuple(latlon)) if latlon else None if values else first(LATLON)
    what = place or (all_of("--values", tuple(values)) if values else first(VALUES))
    if what is None:
        raise Refused(
            f"{path}: say which columns are measured (--values or --latlon); {_listed(have)}"
        )
    return Columns(
        when,
        find("--arrival", arrival, ARRIVALS, taken=when),
        find("--track", track, TRACKS),
        find("--sensor", sensor, SENSORS),
        what,
        place is not None,
    )


def _numbers(path: Path, table: Any, name: str, needed: bool = False) -> np.ndarray:
    """A column as floats: NaN where a cell is empty, unless a number is `needed`."""
    text = table[name]
    number = np.asarray(pd.to_numeric(text, errors="coerce"), float)
    bad = ~np.isfinite(number) & (needed | (text != "").to_numpy())
    if bad.any():
        first = int(np.argmax(bad))
        line, cell = table.index[first] + 2, text.iloc[first]
        raise Refused(f"{path}, line {line}, column {name!r}: expected a number, got {cell!r}")
    return number


def _on_earth(path: Path, table: Any, columns: Columns, value: np.ndarray) -> None:
    for name, number, bound in zip(columns.values, value.T, (90, 360), strict=True):
        bad = np.abs(number) > bound
        if bad.any():
            line = table.index[int(np.argmax(bad))] + 2
            got = number[int(np.argmax(bad))]
            raise Refused(
                f"{path}, line {line}, column {name!r}: expected degrees within ±{bound}, got {got}"
            )


def _listed(have: list[str]) -> str:
    return f"it has {', '.join(have)}"
