"""Tables of pandas or polars as streams of measurements."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ewif_jax import checks, clocks
from ewif_jax.lab.plane import to_plane
from ewif_jax.streams import stream
from ewif_jax.types import Measurement

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0}
"""Units of times that are numbers, in seconds."""


class Frame(Measurement):
    """A `Measurement` (T, ...) in order of arrival, that knows the table it came from.

    arrival (T,): when each arrived, in the seconds of `time`; row (T,): its row in the table;
    first: the date-time (UTC) of second 0, or None where times are numbers; sensors: names by
    index; origin: latitude and longitude of the point (0, 0) of a plane, or None; units: of the
    values ("m" on a plane), as far as known; dropped: how many rows were left out, by reason.
    """

    arrival: np.ndarray
    row: np.ndarray
    first: np.datetime64 | None
    sensors: tuple[Any, ...]
    origin: tuple[float, float] | None
    units: str | None
    dropped: dict[str, int]

    def __repr__(self) -> str:
        if "dropped" not in vars(self):  # rows of one, which know no table
            return super().__repr__()
        steps, size = np.shape(self.value)
        when = "" if self.first is None else f", second 0 is {self.first} UTC"
        unit = "" if self.units is None else f" in {self.units}"
        where = "" if self.origin is None else f", (0, 0) is {self.origin[0]}, {self.origin[1]}"
        gone = ", ".join(f"{count} {reason}" for reason, count in self.dropped.items()) or "none"
        return (
            f"{steps} measurements of {size} numbers{unit} by {len(self.sensors)} sensors{when}"
            f"{where}; rows left out: {gone}"
        )


def from_frame(
    frame: Any,
    *,
    time: str,
    value: str | Sequence[str] | None = None,
    latlon: Sequence[str] | None = None,
    sensor: str | None = None,
    arrival: str | None = None,
    track: str | None = None,
    unit: str = "s",
    units: str | None = None,
    origin: Sequence[float] | None = None,
) -> Any:
    """The measurements in a table, in order of arrival: a `Frame`, which is a `Measurement`; with
    `track` a dict of them, by track.

    What repeats is kept. Left out, and counted in `dropped`, are rows without a time, an arrival, a
    sensor or a track, rows of which nothing was measured, and positions that are none.

    Args:
        frame: of pandas or polars, or anything whose columns are had by name.
        time: column of validity times: numbers (in `unit`), date-times with or without a time zone
            (seconds from the first row that is kept), or durations.
        value: columns that were measured, NaN or null where a component is missing.
        latlon: columns of latitude and longitude in degrees instead: metres east and north of
            `origin` (azimuthal equidistant, WGS84).
        sensor: column of sensors, of any kind; their sorted names become indices 0, 1, ...
        arrival: column of arrival times, like `time`; default: in the order of the table.
        track: column that says which object a row belongs to.
        unit: of times that are numbers: s, ms, us, ns, min, h or d.
        units: of the values, to be said again.
        origin: latitude and longitude of the plane's origin (default: the first position).

    Raises:
        ValueError: a column that is not there; both or neither of `value` and `latlon`; what is
            neither numbers nor times; no row left.
    """
    checks.require(unit in UNITS, "unit", f"one of {', '.join(UNITS)}", repr(unit))
    both = (value is None) != (latlon is None)
    checks.require(both, "value", "columns, or else latlon=(latitude, longitude)", value)
    names = [value] if isinstance(value, str) else list(value or latlon or ())
    two = latlon is None or len(names) == 2
    checks.require(two, "latlon", "two columns, latitude and longitude", latlon)
    values = np.column_stack([_column_numbers(frame, "value", name) for name in names])
    stamps = _column_times(frame, "time", time)
    arrived = stamps if arrival is None else _column_times(frame, "arrival", arrival)
    same = stamps.dtype.kind == arrived.dtype.kind
    checks.require(same, "arrival", f"a column like {time!r}", f"{arrived.dtype}")
    sensor_of = _column_labels(frame, "sensor", sensor)
    track_of = _column_labels(frame, "track", track)
    dropped: dict[str, int] = {}
    kept = np.ones(len(values), bool)

    def drop(reason: str, bad: Any) -> None:
        nonlocal kept
        count = int((kept & bad).sum())
        if count:
            dropped[reason] = count
        kept = kept & ~bad

    drop("without a time", _is_missing(stamps))
    drop("without an arrival", _is_missing(arrived))
    drop("without a sensor", _is_missing(sensor_of))
    drop("without a track", _is_missing(track_of))
    drop("with nothing measured", ~np.isfinite(values).any(1))
    if latlon is not None:
        drop("with half a position", ~np.isfinite(values).all(1))
        latitude, longitude = np.where(kept[:, None], values, 0.0).T
        drop("beyond the pole", np.abs(latitude) > 90)
        # Across the antimeridian people count on to 360; 181 is how AIS says "not available".
        drop("with a longitude beyond 360, or 181", (np.abs(longitude) > 360) | (longitude == 181))
    checks.require(kept.any(), "frame", "at least one row that can be used", dropped or "none")
    rows = np.flatnonzero(kept)
    rows = rows[np.argsort(arrived[rows], kind="stable")] if arrival is not None else rows
    first = stamps[rows[0]] if stamps.dtype.kind == "M" else None
    seconds, late = (_column_seconds(x, rows, first, UNITS[unit]) for x in (stamps, arrived))
    plane = None
    if latlon is not None:
        plane = tuple(float(x) for x in (values[rows[0]] if origin is None else origin))
        values = to_plane(values, np.asarray(plane))
    codes, sensors = _label_codes(sensor_of[rows])
    shared = {
        "first": None if first is None else first.astype("datetime64[ns]"),
        "sensors": sensors,
        "origin": plane,
        "units": "m" if latlon is not None else units,
        "dropped": dropped,
    }

    def of_rows(some: np.ndarray) -> Frame:
        own = Frame(*stream(seconds[some], values[rows[some]], codes[some]))
        about = {"arrival": late[some], "row": rows[some], **shared}
        for name, x in about.items():
            setattr(own, name, x)
        return own

    if track is None:
        return of_rows(np.arange(len(rows)))
    by_track = track_of[rows]
    return {
        name: of_rows(np.flatnonzero(by_track == name)) for name in _sorted_names(set(by_track))
    }


def _frame_column(frame: Any, argument: str, name: str) -> Any:
    have = [str(x) for x in getattr(frame, "columns", frame)]
    expected = f"one of the columns {', '.join(have)}"
    checks.require(name in have, argument, expected, repr(name))
    return frame[name]


def _column_numbers(frame: Any, argument: str, name: str) -> np.ndarray:
    column = _frame_column(frame, argument, name)
    try:
        if hasattr(column, "astype") and hasattr(column, "isna"):  # pandas: NA has no float
            return column.astype("float64").to_numpy()
        found = np.asarray(column.to_numpy() if hasattr(column, "to_numpy") else column)
        return found.astype(float)  # None becomes NaN
    except (TypeError, ValueError) as error:
        raise ValueError(f"{argument}: expected numbers in column {name!r}, got {error}") from error


def _column_times(frame: Any, argument: str, name: str) -> np.ndarray:
    """Date-times in UTC, durations, or numbers."""
    column = _frame_column(frame, argument, name)
    zone = getattr(column.dtype, "tz", None) if hasattr(column, "dtype") else None
    if zone is not None:
        column = column.dt.tz_convert("UTC").dt.tz_localize(None)
    found = np.asarray(column.to_numpy() if hasattr(column, "to_numpy") else column)
    if found.dtype.kind in "mM":
        return found.astype(f"{found.dtype.kind}8[ns]")
    if found.dtype.kind == "O":
        strangers = [x for x in found if x is not None and not _is_nan(x)]
        if strangers and not isinstance(strangers[0], int | float):
            return _from_objects(argument, name, found)
    return _column_numbers(frame, argument, name)


def _from_objects(argument: str, name: str, found: np.ndarray) -> np.ndarray:
    """Date-times that are Python's: those of `clocks`, with NaT where there is none."""
    missing = np.asarray([x is None or _is_nan(x) for x in found])
    words = [x for x in found[~missing] if isinstance(x, str)]
    remedy = "numbers or date-times (pandas.to_datetime makes them of words)"
    checks.require(not words, argument, f"{remedy} in column {name!r}", words[:1])
    stamps = clocks._from_objects(argument, found[~missing])
    whole = np.full(len(found), np.datetime64("NaT"), stamps.value.dtype)
    whole[~missing] = stamps.value
    return whole.astype(f"{whole.dtype.kind}8[ns]")


def _column_labels(frame: Any, argument: str, name: str | None) -> np.ndarray:
    if name is None:
        return np.zeros(len(frame), int)
    column = _frame_column(frame, argument, name)
    return np.asarray(column.to_numpy() if hasattr(column, "to_numpy") else column)


def _is_missing(x: np.ndarray) -> np.ndarray:
    if x.dtype.kind in "mM":
        return np.isnat(x)
    if x.dtype.kind == "f":
        return ~np.isfinite(x)
    if x.dtype.kind == "O":
        return np.asarray([e is None or _is_nan(e) for e in x], bool)
    return np.zeros(len(x), bool)


def _is_nan(x: Any) -> bool:
    """NaN, NaT or NA: what is not the same as itself, or refuses to say."""
    try:
        return bool(x != x)
    except TypeError:
        return True


def _column_seconds(x: np.ndarray, rows: np.ndarray, first: Any, unit: float) -> np.ndarray:
    some = x[rows]
    if some.dtype.kind == "M":
        some = some - first
    return some / np.timedelta64(1, "s") if some.dtype.kind == "m" else some * unit


def _label_codes(labels: np.ndarray) -> tuple[np.ndarray, tuple[Any, ...]]:
    names = _sorted_names(set(labels.tolist()))
    places = {name: k for k, name in enumerate(names)}
    return np.asarray([places[x] for x in labels.tolist()], np.int32), tuple(names)


def _sorted_names(names: set[Any]) -> list[Any]:
    try:
        return sorted(names)
    except TypeError:  # of several kinds
        return sorted(names, key=str)
