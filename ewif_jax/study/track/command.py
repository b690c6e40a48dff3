"""`ewif-jax track`: a filter over the measurements in a CSV file, before and after tuning."""

import argparse
import hashlib
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd
import xarray as xr

from ewif_jax.fast.compiling import array
from ewif_jax.lab.plane import to_degrees
from ewif_jax.study.shared.experiment import Experiment, Measured, Options, shown_number
from ewif_jax.study.shared.refusal import Refused
from ewif_jax.study.track import figures as track_figures
from ewif_jax.study.track.held_out import HeldOut, held_out
from ewif_jax.study.track.loss import filtered, loss, predicted, report
from ewif_jax.study.track.method import TrackMethod, track_method
from ewif_jax.study.track.readings import Readings, read
from ewif_jax.study.track.tracks import Tracks, batch
from ewif_jax.tuning import Tuned, tune
from ewif_jax.types import Measurement, Params, Status

AXES = "xyz"
READING = ("time", "date", "arrival", "track", "sensor", "values", "latlon", "decimal", "dates")
"""the options that say how to read the file"""
LABEL = {
    "median": "median prediction error (smooth) [m]",
    "robust": "mean prediction error [m]",
    "squared": "root mean square prediction error [m]",
    "likelihood": "mean negative log likelihood",
}


class Outcome(NamedTuple):
    """One kind of time stamps: what the filter found with the parameter before and after tuning
    (the same without), and the tuning history."""

    stamps: str
    before: dict[str, np.ndarray]
    after: dict[str, np.ndarray]
    value: tuple[float, float]
    history: dict[str, Any] | None


def track(arguments: argparse.Namespace, options: Options) -> None:
    """Reads, filters, tunes if asked to, and reports."""
    given = {name: getattr(arguments, name) for name in READING}
    readings = read(arguments.file, **given)
    tracks = batch(readings, min_points=arguments.min_points, drop_stale=arguments.drop_stale)
    if tracks.value.shape[-1] > len(AXES):
        raise Refused(f"--values: expected at most {len(AXES)} columns")
    counted = tracks.rank() >= arguments.warm_up
    if arguments.tune and not counted.any():
        raise Refused(f"--warm-up: {arguments.warm_up} leaves no measurement to tune by")
    chosen = track_method(arguments, tracks)
    with Experiment("track", options, _command_settings(arguments)) as experiment:
        _followed_tracks(experiment, arguments, readings, tracks, counted, chosen)


def _followed_tracks(
    experiment: Experiment,
    arguments: argparse.Namespace,
    readings: Readings,
    tracks: Tracks,
    counted: np.ndarray,
    chosen: TrackMethod,
) -> None:
    _introduce_file(experiment, readings, tracks)
    stamped = {"validity": [group.measurements for group in tracks.groups]}
    if readings.columns.arrival is not None:
        stamped["report"] = [g.measurements._replace(time=g.arrival) for g in tracks.groups]
    outcomes = [
        _setting_outcome(experiment, arguments, chosen, stamps, tracks, streams, counted)
        for stamps, streams in stamped.items()
    ]
    _save_estimates(experiment, readings, tracks, outcomes)
    experiment.figure("tracks", track_figures.track_maps(tracks, outcomes[0].after))
    experiment.figure("innovations", track_figures.innovation_panels(tracks, outcomes[0], counted))
    if arguments.tune:
        drawn = track_figures.outcome_histories(
            outcomes, chosen.name, chosen.unit, LABEL[arguments.loss]
        )
        experiment.figure("tuning", drawn)
    seed = arguments.seed
    rows = [row for o in outcomes for row in _outcome_rows(o, chosen, tracks.row, counted, seed)]
    title = f"One-step prediction: {arguments.estimator}, {arguments.model}"
    notes = [_status_counts(outcomes[0]), *_lost_rows(outcomes, counted)]
    if not counted.any():
        notes.append(f"--warm-up: {arguments.warm_up} leaves no measurement to score.")
    experiment.table("track", title, rows, notes)
    experiment.finish()


def _setting_outcome(
    experiment: Experiment,
    arguments: argparse.Namespace,
    chosen: TrackMethod,
    stamps: str,
    tracks: Tracks,
    streams: list[Measurement],
    counted: np.ndarray,
) -> Outcome:
    batches = [
        (group.tracks, jax.tree.map(array, stream))
        for group, stream in zip(tracks.groups, streams, strict=True)
    ]
    with experiment.timed("filtering"):
        before = after = filtered(chosen, chosen.params, tracks, batches)
    start = chosen.params[chosen.name]
    if not arguments.tune:
        return Outcome(stamps, before, after, (float(start), float(start)), None)
    label = f"tuning {chosen.name} ({stamps} times)"
    with experiment.timed(label), experiment.progress(label) as progress:
        price = loss(arguments.loss, chosen, batches)

        def search(params: Params, rows: list[np.ndarray], told: Any = None) -> Tuned:
            return tune(
                price,
                {**params, "counted": rows},
                fixed="counted",
                steps=arguments.steps,
                transforms={chosen.name: chosen.transform},
                progress=told,
            )

        rows = [np.asarray(x, float) for x in tracks.grouped(counted, False)]
        tuned = search({chosen.name: start}, rows, progress)
    with experiment.timed(f"{chosen.name} without some rows ({stamps} times)"):
        checked = held_out(
            price,
            lambda params, kept: float(search(params, kept).params[chosen.name]),
            chosen.name,
            float(tuned.params[chosen.name]),
            tracks,
            counted,
        )
    _tell_result(experiment, stamps, chosen, LABEL[arguments.loss], tuned, checked)
    with experiment.timed("filtering"):
        best = {chosen.name: tuned.params[chosen.name]}
        after = filtered(chosen, {**chosen.params, **best}, tracks, batches)
    value = float(start), float(tuned.params[chosen.name])
    return Outcome(stamps, before, after, value, tuned.history)


def _tell_result(
    experiment: Experiment,
    stamps: str,
    chosen: TrackMethod,
    label: str,
    tuned: Tuned,
    checked: HeldOut | None,
) -> None:
    """Says how far the parameter is known, what it is worth on other rows, and why it ended."""
    value = tuned.params[chosen.name]
    number = Measured(float(value), np.nan) if checked is None else checked.value
    said = [f"{chosen.name} = {shown_number(number)} {chosen.unit} ({stamps} times)"]
    if checked is not None:
        groups = f"{checked.groups} groups of {checked.of}"
        said.append(
            f"{label}: {checked.fitted:.4g} fitted, {checked.held_out:.4g} held out, with the "
            f"standard error by leaving out {groups}"
        )
    experiment.say(f"{'; '.join(said)}. Ended: {tuned.reason}.")


def _introduce_file(experiment: Experiment, readings: Readings, tracks: Tracks) -> None:
    experiment.say(" ".join([str(readings.columns), *readings.notes]))
    left = "".join(f"; {count} {why}" for why, count in tracks.dropped.items())
    experiment.say(
        f"{len(readings.time)} rows: {len(tracks.row)} measurements of {len(tracks.name)} tracks"
        f"{left and '. Left out or missing: ' + left[2:]}."
    )


def _outcome_rows(
    outcome: Outcome, chosen: TrackMethod, row: np.ndarray, counted: np.ndarray, seed: int
) -> list[dict[str, Any]]:
    pairs = [("given" if outcome.history is None else "before", outcome.value[0], outcome.before)]
    if outcome.history is not None:
        pairs.append(("tuned", outcome.value[1], outcome.after))
    # Otherwise a filter that loses the rows that are hard to predict would look better.
    used = counted & predicted(outcome.before) & predicted(outcome.after)
    return [
        {
            "times": outcome.stamps,
            "setting": setting,
            f"{chosen.name} [{chosen.unit}]": value,
            **report(found, row, used, seed),
        }
        for setting, value, found in pairs
    ]


def _status_counts(outcome: Outcome) -> str:
    status = outcome.after["status"]
    counts = [(kind.name.lower().replace("_", " "), (status == kind).sum()) for kind in Status]
    return "Measurements: " + ", ".join(f"{count} {kind}" for kind, count in counts if count)


def _lost_rows(outcomes: list[Outcome], counted: np.ndarray) -> list[str]:
    """What to say of rows that only one of the two settings predicts, which no row counts."""
    notes = []
    for outcome in outcomes:
        before, after = counted & predicted(outcome.before), counted & predicted(outcome.after)
        if (before != after).any():
            notes.append(
                f"Left out of both ({outcome.stamps} times): {(before & ~after).sum()} "
                f"predicted before tuning only, {(after & ~before).sum()} after tuning only."
            )
    return notes


def _save_estimates(
    experiment: Experiment, readings: Readings, tracks: Tracks, outcomes: list[Outcome]
) -> None:
    """estimates.csv and track.nc: what the filter says after each measurement, of the time
    `estimate_time`."""
    found, row = outcomes[0].after, tracks.row
    states = state_names(found["mean"].shape[-1], tracks.value.shape[-1])
    # a late row leaves the state at the newest time so far
    newest = pd.Series(tracks.time).groupby(row).cummax().to_numpy()
    frame = {
        "track": tracks.name[row],
        "line": tracks.line,
        "time": tracks.time + tracks.start[row],
        "arrival": tracks.arrival + tracks.start[row],
        "estimate_time": newest + tracks.start[row],
    }
    frame |= dict(zip(states, found["mean"].T, strict=True))
    frame |= {f"sd_{n}": x for n, x in zip(states, found["sd"].T, strict=True)}
    if tracks.origin is not None:
        cuts = np.searchsorted(row, np.arange(1, len(tracks.name)))
        means = np.split(found["mean"][:, :2], cuts)
        place = [to_degrees(m, o) for o, m in zip(tracks.origin, means, strict=True)]
        frame |= dict(zip(readings.columns.values, np.concatenate(place).T, strict=True))
    frame |= {
        "prediction_error": found["error"],
        "nis_per_component": found["nis"],
        "status": [Status(s).name.lower() for s in found["status"]],
    }
    experiment.csv("estimates", pd.DataFrame(frame))
    dims = ("stamps", "setting", "row")
    both = {
        name: np.stack([np.stack([o.before[name], o.after[name]]) for o in outcomes])
        for name in found
    }
    since = {"units": "s", "long_name": "since start"}
    arrays = {
        "track_of_row": ("row", row, {"instance_dimension": "track"}),
        "time": ("row", tracks.time, since),
        "arrival": ("row", tracks.arrival, since),
        "estimate_time": ("row", newest, since),
        "start": ("track", tracks.start, {"units": "s"}),
        "value": (("row", "axis"), tracks.value, {"units": "m"}),
        "mean": ((*dims, "state"), both["mean"], {"units": "m, m/s, m/s^2"}),
        "sd": ((*dims, "state"), both["sd"], {"units": "m, m/s, m/s^2"}),
        "innovation": ((*dims, "axis"), both["innovation"], {"units": "m"}),
        "nis_per_component": (dims, both["nis"], {"units": "1"}),
        "status": (dims, both["status"], {"meaning": str({s.name: s.value for s in Status})}),
    }
    coords = {
        "stamps": [outcome.stamps for outcome in outcomes],
        "setting": ["before", "after"],
        "track": tracks.name,
        "state": states,
    }
    experiment.arrays("track", xr.Dataset(arrays, coords))


def state_names(n: int, dims: int) -> list[str]:
    """x, y, vx, vy, ...: the names of the state's components."""
    return [prefix + axis for prefix in ("", "v", "a")[: n // dims] for axis in AXES[:dims]]


def _command_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    left_out = ("action", "out", "overwrite", "runs", "quick", "chunk", "dtype", "seed")
    given = {k: str(v) for k, v in vars(arguments).items() if k not in left_out}
    digest = hashlib.sha256(arguments.file.read_bytes()).hexdigest()[:12]
    return {**given, "file_digest": digest}
