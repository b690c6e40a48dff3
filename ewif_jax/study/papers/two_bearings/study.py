"""Pornsarayouth & Yamakita, sections 5 and 6: two rotating bearing sensors, one of them late."""

from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from ewif_jax.analysis.storage import storage
from ewif_jax.study.papers.two_bearings import figures
from ewif_jax.study.papers.two_bearings import runs as runs_of
from ewif_jax.study.papers.two_bearings.claims import (
    LOST,
    SETTLED,
    bearings_claims,
    lost,
    reported,
    squared,
)
from ewif_jax.study.papers.two_bearings.runs import (
    DELAYS,
    LAG,
    MEMBERS,
    BearingsMethod,
    World,
)
from ewif_jax.study.shared.claims import share
from ewif_jax.study.shared.experiment import Experiment
from ewif_jax.study.shared.folder import Arrays
from ewif_jax.study.shared.late import mean_of, rmse_of
from ewif_jax.study.shared.late_methods import storage_rows
from ewif_jax.study.shared.one_by_one import seconds_per_run


def run(experiment: Experiment) -> None:
    """Simulates each delay, runs every filter on it, and compares them with the paper."""
    runs = experiment.size(100, 8)
    used = runs_of.bearings_methods(1000 if experiment.options.quick else 10_000)
    with experiment.timed("simulation"):
        world = runs_of.bearings_world(experiment.key(0), runs)
    found = {
        name: experiment.piece(
            f"filter-{i}", partial(_timed_filter, experiment, name, method, world)
        )
        for i, (name, method) in enumerate(used.items())
    }
    with experiment.timed("bounds"):
        bound = experiment.piece("bounds", lambda: runs_of.bearings_bounds(world))
    truth = np.reshape(world.batch.truth, (len(DELAYS), runs, -1, 2))
    for k, delay in enumerate(DELAYS):
        stem = f"delay_{delay:g}s"
        experiment.figure(f"{stem}_tracks", figures.bearing_tracks(found, truth[k, 0], k, delay))
        experiment.figure(
            f"{stem}_errors", figures.bearing_errors(found, bound, world.times[k], k, delay)
        )
    experiment.figure("delays", figures.by_delay(*_mean_squares(found, bound, world.times), DELAYS))
    experiment.arrays("two_bearings", _bearings_arrays(found, bound, world.times))
    experiment.table("storage", f"Storage, lag {LAG}", storage_rows(4, 1, lag=LAG, members=MEMBERS))
    experiment.table(
        "two_bearings",
        f"Two bearings, {runs} runs, t >= {SETTLED:g} s",
        _filter_rows(found, bound, world.times, used),
        [
            f"lost: share of runs that are ever more than {LOST:g} m off; a RMSE with lost runs in",
            "it says little. s/run: on one core, one run after the other, without compiling.",
        ],
    )
    experiment.table(
        "claims",
        "What the paper says",
        bearings_claims(found, bound, world.times),
        [
            "runs: how many decide. Ratios are over those in which neither filter is ever",
            f"{LOST:g} m off. Nearest rival: of EKF, RTS-based, EnKF2, also with shared noise, and",
            "exact replay, the one from which EnKF1 differs least surely. Times are of one core.",
        ],
    )
    experiment.finish()


def _timed_filter(
    experiment: Experiment, name: str, method: BearingsMethod, world: World
) -> Arrays:
    with experiment.timed(name):
        return runs_of.followed_bearings(method, world, experiment.key(1))


def _mean_squares(
    found: dict[str, Arrays], bound: Arrays, times: np.ndarray
) -> tuple[dict[str, Any], Any, dict[str, Any]]:
    """Mean squares (D, R) by filter and of the bound, and which runs are lost."""
    off = {name: squared(one["error"], times) for name, one in found.items()}
    floor = squared(np.sqrt(bound["right"]), times)
    return off, floor, {name: lost(one["error"]) for name, one in found.items()}


def _filter_rows(
    found: dict[str, Arrays], bound: Arrays, times: np.ndarray, used: dict[str, BearingsMethod]
) -> list[dict[str, Any]]:
    off, _, gone = _mean_squares(found, bound, times)
    rows: list[dict[str, Any]] = []
    for k, delay in enumerate(DELAYS):
        for name, method in used.items():
            rows.append(
                {
                    "delay [s]": delay,
                    "estimator": name,
                    "RMSE [m]": rmse_of(off[name][k]),
                    "mean SD [m]": mean_of(reported(found[name]["variance"], times)[k]),
                    "median [m]": float(np.median(np.sqrt(off[name][k]))),
                    "lost": share(gone[name][k]),
                    "s/run": seconds_per_run(found[name]["core_seconds"][k]),
                    "numbers stored": storage(method.estimator, 4).numbers,
                }
            )
        for name, kind in (("PCRLB", "right"), ("PCRLB as published", "published")):
            value = rmse_of(squared(np.sqrt(bound[kind]), times)[k])
            empty: dict[str, Any] = dict.fromkeys(rows[0])
            rows.append({**empty, "delay [s]": delay, "estimator": name, "RMSE [m]": value})
    return rows


def _bearings_arrays(found: dict[str, Arrays], bound: Arrays, times: np.ndarray) -> xr.Dataset:
    dims, metres = ("estimator", "delay", "run", "arrival", "axis"), {"units": "m"}

    def stacked(values: list[np.ndarray]) -> xr.DataArray:
        x = np.stack(values)
        return xr.DataArray(x, dims=dims[: x.ndim], attrs=metres)

    every = list(found.values())
    fields = {
        "error": stacked([one["error"] for one in every]),
        "reported_sd": stacked([np.sqrt(one["variance"]) for one in every]),
        "rmse_of_run": stacked([np.sqrt(squared(one["error"], times)) for one in every]),
        "arrival_time": xr.DataArray(times, dims=("delay", "arrival"), attrs={"units": "s"}),
    }
    for kind, name in (("right", "pcrlb"), ("published", "pcrlb_published")):
        fields[name] = xr.DataArray(np.sqrt(bound[kind]), dims=dims[1:], attrs=metres)
    return xr.Dataset(fields).assign_coords(
        estimator=list(found), axis=["x", "y"], delay=("delay", list(DELAYS), {"units": "s"})
    )
