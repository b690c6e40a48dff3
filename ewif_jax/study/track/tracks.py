"""Measurements of a file as one padded batch of tracks."""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyproj

from ewif_jax.study.shared.experiment import Refused
from ewif_jax.study.track.readings import Readings
from ewif_jax.types import Measurement


class Tracks(NamedTuple):
    """R tracks of at most T arrivals, each in order of arrival.

    name (R,); start (R,): time of the first arrival's measurement in seconds; origin (R, 2):
    latitude and longitude of the local plane's origin, or None; measurements: a `Measurement` of
    NumPy arrays (R, T, ...), times from the
    start, values in metres; arrival (R, T): report times from the start; present (R, T): False is
    padding; line (R, T): in the file; dropped: how many rows were left out, by reason.
    """

    name: np.ndarray
    start: np.ndarray
    origin: np.ndarray | None
    measurements: Any
    arrival: np.ndarray
    present: np.ndarray
    line: np.ndarray
    sensors: list[str]
    dropped: dict[str, int]


def batch(readings: Readings, *, min_points: int = 1, drop_stale: bool = False) -> Tracks:
    """Groups, sorts by arrival, drops what says nothing new, turns degrees into metres, and pads.

    A row says nothing new if it has no value, or repeats an earlier row's track, sensor, time and
    values; with `drop_stale` also if it repeats the values of the row before it.

    Raises:
        Refused: no track has `min_points` rows left.
    """
    values = [f"value{i}" for i in range(readings.value.shape[1])]
    frame: Any = pd.DataFrame(readings.value, columns=values).assign(
        track=readings.track,
        sensor=readings.sensor,
        time=readings.time,
        arrival=readings.arrival,
        line=readings.line,
    )
    if readings.columns.geographic:
        frame.loc[frame[values].isna().any(axis=1), values] = np.nan
    kept = frame[frame[values].notna().any(axis=1)].sort_values("arrival", kind="stable")
    dropped = {"empty": len(frame) - len(kept)}
    repeat = kept.duplicated(["track", "sensor", "time", *values])
    if drop_stale:
        before = kept.groupby(["track", "sensor"])[values].shift()
        repeat |= (kept[values] == before).all(axis=1)
    dropped["repeating an older position"] = int(repeat.sum())
    kept = kept[~repeat]
    counts = kept.groupby("track")["time"].transform("size")
    dropped["in shorter tracks"] = int((counts < min_points).sum())
    kept = kept[counts >= min_points]
    if kept.empty:
        raise Refused(f"no track has {min_points} distinct positions (--min-points)")
    sensors = sorted(kept["sensor"].unique())
    groups = list(kept.groupby("track", sort=True))
    places = [_local(group[values].to_numpy(), readings.columns.geographic) for _, group in groups]
    origin = np.array([place[1] for place in places]) if readings.columns.geographic else None
    start = np.array([group["time"].iloc[0] for _, group in groups])
    value = _padded([place[0] for place in places], np.nan)
    present = _padded([np.ones(len(group), bool) for _, group in groups], False)
    time, arrival = (
        _padded([group[name].to_numpy() - group["time"].iloc[0] for _, group in groups])
        for name in ("time", "arrival")
    )
    code = [np.searchsorted(sensors, group["sensor"]).astype(np.int32) for _, group in groups]
    mask = np.isfinite(value) & present[..., None]
    fields: Any = (time, np.where(mask, value, 0), _padded(code), mask)
    return Tracks(
        np.array([name for name, _ in groups]),
        start,
        origin,
        Measurement(*fields),
        arrival,
        present,
        _padded([group["line"].to_numpy() for _, group in groups]),
        sensors,
        {reason: count for reason, count in dropped.items() if count},
    )


def degrees(origin: np.ndarray, metres: np.ndarray) -> np.ndarray:
    """Latitude and longitude (N, 2) of positions (N, 2), east and north of an origin."""
    longitude, latitude = _plane(origin)(metres[:, 0], metres[:, 1], inverse=True)
    return np.column_stack([latitude, longitude])


def _local(value: np.ndarray, geographic: bool) -> tuple[np.ndarray, np.ndarray]:
    """Metres east and north of the first position (azimuthal equidistant), and that position."""
    if not geographic:
        return value, value[0]
    east, north = _plane(value[0])(value[:, 1], value[:, 0])
    return np.column_stack([east, north]), value[0]


def _plane(origin: np.ndarray) -> pyproj.Proj:
    return pyproj.Proj(proj="aeqd", lat_0=origin[0], lon_0=origin[1], ellps="WGS84")


def _padded(rows: list[np.ndarray], fill: float | bool | None = None) -> np.ndarray:
    """Rows of different lengths as one array; `fill` None repeats the last entry."""
    longest = max(len(row) for row in rows)

    def pad(row: np.ndarray) -> np.ndarray:
        tail = row[-1] if fill is None else fill
        filler = np.broadcast_to(np.asarray(tail, row.dtype), (longest - len(row), *row.shape[1:]))
        return np.concatenate([row, filler])

    return np.stack([pad(row) for row in rows])
