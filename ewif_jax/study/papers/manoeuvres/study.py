"""Targets that manoeuvre, seen late: the arrowhead of Yoder et al. and the turn of Orguner and
Gustafsson, by EWIF, Kalman filter and interacting multiple models."""

from functools import partial
from typing import Any

import jax
import numpy as np
import xarray as xr

from ewif_jax.lab import Comparison, Method
from ewif_jax.monte_carlo import simulate_batch
from ewif_jax.study.papers.manoeuvres import figures
from ewif_jax.study.papers.manoeuvres import runs as runs_of
from ewif_jax.study.papers.manoeuvres.runs import KALMAN, Manoeuvre
from ewif_jax.study.shared.experiment import Experiment, Measured
from ewif_jax.study.shared.folder import Arrays
from ewif_jax.study.shared.one_by_one import per_run

SETTLED = 5.0
"""seconds from the start that do not count"""
USE = {"used": True, "dropped": False}


def run(experiment: Experiment) -> None:
    """Sets every filter on runs of its own, with late data and without, and compares on others."""
    quick = experiment.options.quick
    worlds = {
        "arrowhead": (runs_of.arrowhead_manoeuvre(60 if quick else 400), experiment.size(100, 4)),
        "turn": (runs_of.turn_manoeuvre(), experiment.size(400, 4)),
    }
    rows, arrays, settings = [], {}, {}
    for number, (world, (manoeuvre, runs)) in enumerate(worlds.items()):
        for use, late in USE.items():
            name = f"{world}, late {use}"
            chosen = experiment.piece(
                f"settings, {name}", partial(_chosen, experiment, manoeuvre, late, number)
            )
            found = _compared(experiment, name, manoeuvre, chosen, runs, late, number)
            rows += _method_rows(world, use, found, chosen)
            arrays[f"{world}_{use}_rmse_of_run"] = _rmse_of_runs(found, f"{world}_run")
            settings[name] = chosen
    experiment.table(
        "manoeuvres",
        "Manoeuvres seen late, RMSE of the position",
        rows,
        [
            "Every filter has the best of its settings on other runs, with late data and without.",
            "Late data: the EWIF takes them as they are, the others by an exact replay.",
            "minus Kalman: run by run, on the same use of late data.",
        ],
    )
    example = runs_of.example_modes(
        worlds["arrowhead"][0], settings["arrowhead, late used"], experiment.key(9)
    )
    experiment.arrays("manoeuvres", xr.Dataset(arrays))
    experiment.figure("errors", figures.errors(rows))
    experiment.figure("modes", figures.modes(example))
    experiment.finish()


def _chosen(experiment: Experiment, manoeuvre: Manoeuvre, late: bool, number: int) -> Arrays:
    runs = 2 if experiment.options.quick else 16
    keys = jax.random.split(experiment.key(10 + number), runs)
    batch = per_run(simulate_batch(manoeuvre.scenario, keys))
    with experiment.timed("settings"), experiment.progress("settings") as report:
        return runs_of.chosen_settings(manoeuvre, late, batch, report)


def _compared(
    experiment: Experiment,
    name: str,
    manoeuvre: Manoeuvre,
    chosen: Arrays,
    runs: int,
    late: bool,
    number: int,
) -> Comparison:
    methods = {
        filter_name: Method(
            runs_of.with_late_data(manoeuvre, filter_name, late),
            runs_of.params_of(chosen, filter_name),
            prior=manoeuvre.prior,
        )
        for filter_name in manoeuvre.filters
    }
    key = experiment.key(number)
    return experiment.compare(
        name, methods, manoeuvre.scenario, runs=runs, key=key, warm_up=SETTLED
    )


def _method_rows(world: str, use: str, found: Comparison, chosen: Arrays) -> list[dict[str, Any]]:
    table, rows = found.table(reference=KALMAN).set_index("method"), []
    row: Any
    for name, row in table.iterrows():
        params = runs_of.params_of(chosen, str(name))
        against = Measured(row["difference"], row["difference_error"])
        rows.append(
            {
                "target": world,
                "late data": use,
                "filter": name,
                "RMSE [m]": Measured(row["value"], row["error"]),
                "minus Kalman [m]": None if name == KALMAN else against,
                "setting": ", ".join(f"{k} {v:.3g}" for k, v in params.items()),
            }
        )
    return rows


def _rmse_of_runs(found: Comparison, dimension: str) -> xr.DataArray:
    squared = found.dataset["squared_error"]
    rmse = np.sqrt(squared.transpose("method", "run").values)
    return xr.DataArray(
        rmse, dims=("method", dimension), coords={"method": found.methods}, attrs={"units": "m"}
    )
