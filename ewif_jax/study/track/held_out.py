"""How far a tuned parameter is known, and what its error is on rows it was not tuned by."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from ewif_jax.study.shared.experiment import Measured
from ewif_jax.study.track.tracks import Tracks

GROUPS = 5
GAP = 5
"""Rows of a track between those that it is tuned by and those held out."""


class HeldOut(NamedTuple):
    """The parameter and its standard error; the loss of rows it was tuned by and of rows held out,
    each averaged over the groups; how many groups, and of what."""

    value: Measured
    fitted: float
    held_out: float
    groups: int
    of: str


def row_groups(tracks: Tracks, counted: np.ndarray) -> tuple[list[np.ndarray], str]:
    """Up to `GROUPS` groups (N,) bool of the counted rows: of whole tracks if there are several,
    else of stretches of time."""
    own = np.unique(tracks.row[counted])
    if len(own) > 1:
        sizes = np.bincount(tracks.row[counted], minlength=len(tracks.name))
        totals = np.zeros(min(GROUPS, len(own)))
        group_of = np.full(len(tracks.name), -1)
        for track in own[np.argsort(-sizes[own], kind="stable")]:
            group_of[track] = np.argmin(totals)
            totals[group_of[track]] += sizes[track]
        groups = [counted & (group_of[tracks.row] == k) for k in range(len(totals))]
        return groups, "tracks"
    places = np.flatnonzero(counted)
    parts = np.array_split(places, min(GROUPS, max(len(places) // (4 * GAP), 1)))
    groups = [np.isin(np.arange(len(counted)), part) for part in parts]
    return groups, "stretches of time"


def without(group: np.ndarray, counted: np.ndarray, tracks: Tracks) -> np.ndarray:
    """The counted rows outside of a group, `GAP` rows of the same track away from it."""
    near = group.copy()
    for shift in range(1, GAP + 1):
        same = tracks.row[shift:] == tracks.row[:-shift]
        near[shift:] |= group[:-shift] & same
        near[:-shift] |= group[shift:] & same
    return counted & ~near


def held_out(
    loss: Callable[[Any], Any],
    tuned: Callable[[dict[str, Any], list[np.ndarray]], float],
    name: str,
    value: float,
    tracks: Tracks,
    counted: np.ndarray,
) -> HeldOut | None:
    """Tunes again without each group of rows, and asks for the loss of the group.

    The standard error is that of the jackknife that leaves out groups: it holds for any loss, and
    for a filter whose likelihood is no model of the data. None if there are not two groups.

    Args:
        loss: of a mapping of the parameter and "counted", the rows (G, T) of each batch.
        tuned: what the parameter becomes from a start, by the rows given.
        name: the parameter's; value: what it became by all rows.
        tracks: the rows; counted: (N,) those that are scored.
    """
    groups, kind = row_groups(tracks, counted)
    if len(groups) < 2:
        return None
    price = jax.jit(loss)
    found, losses = [], []
    for group in groups:
        kept, left = (
            [np.asarray(x, float) for x in tracks.grouped(rows, False)]
            for rows in (without(group, counted, tracks), group)
        )
        own = tuned({name: value}, kept)
        found.append(own)
        losses.append([float(price({name: own, "counted": rows})) for rows in (kept, left)])
    count = len(groups)
    # In logarithms, in which the parameter was tuned: its error is relative.
    logs = np.log(np.abs(found))
    spread = np.sqrt((count - 1) / count * np.sum(np.square(logs - logs.mean())))
    fitted, left_out = np.mean(losses, 0)
    return HeldOut(Measured(value, abs(value) * spread), fitted, left_out, count, kind)
