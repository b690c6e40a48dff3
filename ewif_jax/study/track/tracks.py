"""Measurements of a file as padded batches of tracks of like length."""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from ewif_jax.lab.plane import to_plane
from ewif_jax.study.shared.refusal import Refused
from ewif_jax.study.track.readings import Readings
from ewif_jax.types import Measurement

MOST_PADDING = 4
"""times as many places as rows in a batch, at most: more batches compile longer, more padding
computes longer"""


class Group(NamedTuple):
    """G tracks of at most T arrivals, each in order of arrival.

    tracks (G,): which; measurements: a `Measurement` of NumPy arrays (G, T, ...), times from the
    start of each track; arrival (G, T): report times from there; present (G, T): False is padding.
    """

    tracks: np.ndarray
    measurements: Any
    arrival: np.ndarray
    present: np.ndarray


class Tracks(NamedTuple):
    """R tracks with N rows in all.

    name (R,); start (R,): time of the first arrival's measurement in seconds; origin (R, 2):
    latitude and longitude of the local plane's origin, or None; groups: the tracks as batches;
    dropped: how many rows were left out, by reason. The rows, track by track, each in order of
    arrival: row (N,) the track; line (N,) in the file; time, arrival (N,) from the track's start;
    value, mask (N, m) in metres.
    """

    name: np.ndarray
    start: np.ndarray
    origin: np.ndarray | None
    groups: tuple[Group, ...]
    sensors: list[str]
    dropped: dict[str, int]
    row: np.ndarray
    line: np.ndarray
    time: np.ndarray
    arrival: np.ndarray
    value: np.ndarray
    mask: np.ndarray

    @property
    def present(self) -> np.ndarray:
        """The places of all batches, True where there is a row: (R, T) of the only one, or flat."""
        if len(self.groups) == 1:
            return self.groups[0].present
        return np.concatenate([group.present.ravel() for group in self.groups])

    def rank(self) -> np.ndarray:
        """The place (N,) of each row in its track."""
        first = np.searchsorted(self.row, self.row)
        return np.arange(len(self.row)) - first

    def flat(self, of_groups: list[np.ndarray]) -> np.ndarray:
        """The rows (N, ...) of arrays (G, T, ...), one for each group."""
        found = np.empty((len(self.row), *of_groups[0].shape[2:]), of_groups[0].dtype)
        begin = np.searchsorted(self.row, np.arange(len(self.name)))
        for group, values in zip(self.groups, of_groups, strict=True):
            for track, here, rows in zip(group.tracks, group.present, values, strict=True):
                count = int(here.sum())
                found[begin[track] : begin[track] + count] = rows[:count]
        return found

    def grouped(self, rows: np.ndarray, fill: Any) -> list[np.ndarray]:
        """The opposite of `flat`: arrays (G, T, ...) with `fill` where nothing is (None: the last
        row of the track again)."""
        parts = np.split(rows, np.searchsorted(self.row, np.arange(1, len(self.name))))
        return [
            _padded_rows([parts[track] for track in group.tracks], fill) for group in self.groups
        ]


def batch(readings: Readings, *, min_points: int = 1, drop_stale: bool = False) -> Tracks:
    """Groups, sorts by arrival, drops what says nothing new, turns degrees into metres, and pads
    tracks of like length to batches.

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
    dropped = {**dict(readings.dropped), "empty": len(frame) - len(kept)}
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
    parts = list(kept.groupby("track", sort=True))
    places = [
        _local_metres(part[values].to_numpy(), readings.columns.geographic) for _, part in parts
    ]
    start = np.array([part["time"].iloc[0] for _, part in parts])
    size = np.array([len(part) for _, part in parts])
    row = np.repeat(np.arange(len(parts)), size)
    every: Any = pd.concat([part for _, part in parts])
    value = np.concatenate([place[0] for place in places])
    tracks = Tracks(
        np.array([name for name, _ in parts]),
        start,
        np.array([place[1] for place in places]) if readings.columns.geographic else None,
        tuple(Group(some, None, size, size) for some in _like_lengths(size)),
        sensors,
        {reason: count for reason, count in dropped.items() if count},
        row,
        every["line"].to_numpy(),
        every["time"].to_numpy() - start[row],
        every["arrival"].to_numpy() - start[row],
        value,
        np.isfinite(value),
    )
    code = np.searchsorted(sensors, every["sensor"]).astype(np.int32)
    filled = np.where(tracks.mask, value, 0)
    fields = [
        tracks.grouped(x, fill)
        for x, fill in ((tracks.time, None), (filled, None), (code, None), (tracks.mask, False))
    ]
    arrivals, places_used = (
        tracks.grouped(tracks.arrival, None),
        tracks.grouped(np.ones(len(row), bool), False),
    )
    streams = [Measurement(*some) for some in zip(*fields, strict=True)]
    groups = zip(tracks.groups, streams, arrivals, places_used, strict=True)
    return tracks._replace(
        groups=tuple(Group(g.tracks, stream, late, here) for g, stream, late, here in groups)
    )


def _like_lengths(size: np.ndarray) -> list[np.ndarray]:
    """Tracks to be padded together: all, unless that makes more than `MOST_PADDING` times as many
    places as rows. Then from the longest down, as many as stay below that."""
    if size.max() * size.size <= MOST_PADDING * size.sum():
        return [np.arange(size.size)]
    order = np.argsort(-size, kind="stable")
    found, begin = [], 0
    for end in range(1, size.size + 1):
        following = order[begin : end + 1]
        if end == size.size or size[following[0]] > MOST_PADDING * size[following[-1]]:
            found.append(np.sort(order[begin:end]))
            begin = end
    return found


def _local_metres(value: np.ndarray, geographic: bool) -> tuple[np.ndarray, np.ndarray]:
    """Metres east and north of the first position, and that position."""
    return (to_plane(value, value[0]) if geographic else value), value[0]


def _padded_rows(rows: list[np.ndarray], fill: float | bool | None = None) -> np.ndarray:
    """Rows of different lengths as one array; `fill` None repeats the last entry."""
    longest = max(len(row) for row in rows)

    def pad(row: np.ndarray) -> np.ndarray:
        tail = row[-1] if fill is None else fill
        filler = np.broadcast_to(np.asarray(tail, row.dtype), (longest - len(row), *row.shape[1:]))
        return np.concatenate([row, filler])

    return np.stack([pad(row) for row in rows])
