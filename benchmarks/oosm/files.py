"""A real file as a stream: one run for each track, of which nobody knows the truth."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

import ewif_jax as ej
from benchmarks.oosm.streams import Stream, World, newest_of


class Columns(NamedTuple):
    """Names in the file: time and arrival (numbers of seconds), two values, or latitude and
    longitude if `latlon`; track, or None for one."""

    time: str
    arrival: str
    value: tuple[str, str]
    latlon: bool
    track: str | None


def from_file(
    path: Path, columns: Columns, runs: int, steps: int, delay: float, q: float, r: float, seed: int
) -> Stream:
    """The first `steps` rows of the first `runs` tracks that have as many.

    Rows with a time that was there before are left out. `delay`: a mean of exponential delays, in
    seconds, that is added to the arrivals, for files in which nothing is late.
    """
    frame = pd.read_csv(path)
    rng = np.random.default_rng(seed)
    by = [columns.track] if columns.track else []
    frame = frame.drop_duplicates([*by, columns.time])
    groups = [one for _, one in frame.groupby(columns.track)] if by else [frame]
    parts = []
    for group in groups:
        if len(group) >= steps and len(parts) < runs:
            group = group.sort_values(columns.time).head(steps).copy()
            wait = rng.exponential(delay, steps) if delay else np.zeros(steps)
            group[columns.arrival] = group[columns.arrival].astype(float) + wait
            given = {"latlon" if columns.latlon else "value": list(columns.value)}
            parts.append(
                ej.lab.from_frame(group, time=columns.time, arrival=columns.arrival, **given)
            )
    if not parts:
        raise SystemExit(f"{path}: no track has {steps} rows")
    time, now, value = (
        np.stack([np.asarray(getattr(part, name), float) for part in parts])
        for name in ("time", "arrival", "value")
    )
    start = time.min(1, keepdims=True)
    time, now = time - start, now - start
    # Every track from its own first position, at rest as far as anybody knows.
    first = np.take_along_axis(value, time.argmin(1)[:, None, None], 1)
    world = World(np.zeros(4), np.diag([r, r, 250.0**2, 250.0**2]), q, r)
    newest, _ = newest_of(time, np.ones(time.shape, bool))
    return Stream(
        path.name, f"{len(parts)} tracks of {path.name}", world, time, now, value - first,
        np.ones(time.shape, bool), np.zeros(time.shape, np.int32), newest,
        np.full((*time.shape, 4), np.nan),
    )  # fmt: skip
