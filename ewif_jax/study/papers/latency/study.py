"""Clocks that are off, calibrated from the measurements alone: how well, and how surely."""

from typing import Any

import jax
import numpy as np
import xarray as xr

from ewif_jax.monte_carlo import Simulation, simulate_batch
from ewif_jax.scenarios.three_clocks import three_clocks
from ewif_jax.study.papers.latency import figures
from ewif_jax.study.papers.latency import runs as runs_of
from ewif_jax.study.papers.latency.runs import NAMES, NORMAL_95, ROWS, TRUTH
from ewif_jax.study.shared.claims import share
from ewif_jax.study.shared.experiment import Experiment, Measured
from ewif_jax.study.shared.folder import Arrays
from ewif_jax.study.shared.late import mean_of, paired, rmse_of
from ewif_jax.study.shared.one_by_one import per_run

UNITS = ("1", "s", "s")


def run(experiment: Experiment) -> None:
    """Fits every run's own data, and compares with the truth, a grid, and the Cramer-Rao bound."""
    runs = experiment.size(500, 8)
    few = min(runs, 2 if experiment.options.quick else 20)
    with experiment.timed("simulation"):
        batch = per_run(simulate_batch(three_clocks(), jax.random.split(experiment.key(0), runs)))
    fits = experiment.piece("fits", lambda: _fits(experiment, batch))
    grid = experiment.piece(
        "grid", lambda: _grid(experiment, jax.tree.map(lambda x: x[:few], batch))
    )
    errors = experiment.piece("errors", lambda: _position_errors(experiment, batch, fits))
    experiment.table(
        "latency",
        f"Latencies of two clocks and log q from 60 s of data, {runs} runs",
        _parameter_rows(fits),
        [
            "scatter: standard deviation of the estimates; standard error: what each run says of",
            "its own estimate, on average; bound: Cramer and Rao's, of the average information.",
            f"From q ten times too large and no latency, in at most {int(fits['turns'])} turns.",
        ],
    )
    experiment.table(
        "grid", f"The same from a grid, {few} runs", _grid_rows(fits, grid), [_grid_note(grid)]
    )
    experiment.table("position", f"Error of the position, {runs} runs", _position_rows(errors))
    experiment.arrays("latency", _latency_arrays(fits, grid, errors))
    experiment.figure("landscape", figures.landscape(fits, grid))
    experiment.figure("estimates", figures.estimates(fits))
    experiment.finish()


def _fits(experiment: Experiment, batch: Simulation) -> Arrays:
    with experiment.timed("fits"), experiment.progress("fits") as report:
        found = runs_of.fits_of(batch, report)
    with experiment.timed("q alone"), experiment.progress("q alone") as report:
        stamped = runs_of.fits_as_stamped(batch, report)
    with experiment.timed("errors"), experiment.progress("standard errors") as report:
        errors = runs_of.errors_of_fits(batch, found.point, report)
    with experiment.timed("bound"):
        bound = runs_of.cramer_rao(batch)
    return {
        "point": found.point,
        "cost": found.least,
        "error": errors,
        "stamped": stamped.point,
        "bound": bound,
        "turns": np.asarray(found.turns),
    }


def _grid(experiment: Experiment, batch: Simulation) -> Arrays:
    with experiment.timed("grid"), experiment.progress("grid") as report:
        return {"points": runs_of.grid_points(), "cost": runs_of.grid_costs(batch, report)}


def _position_errors(experiment: Experiment, batch: Simulation, fits: Arrays) -> Arrays:
    runs = len(batch.truth)
    as_stamped = np.concatenate([fits["stamped"], np.zeros((runs, 2))], 1)
    settings = {
        "known": np.tile(TRUTH, (runs, 1)),
        "fitted": fits["point"],
        "as stamped": as_stamped,
    }
    with experiment.timed("position"):
        return {name: runs_of.squared_errors(batch, x) for name, x in settings.items()}


def _parameter_rows(fits: Arrays) -> list[dict[str, Any]]:
    rows = []
    for k, name in enumerate(NAMES):
        off, error = fits["point"][:, k] - TRUTH[k], fits["error"][:, k]
        scatter, runs = float(off.std(ddof=1)), off.size
        rows.append(
            {
                "parameter": name,
                "unit": UNITS[k],
                "truth": float(TRUTH[k]),
                "mean error": mean_of(off),
                "scatter": Measured(scatter, scatter / np.sqrt(2 * (runs - 1))),
                "standard error": mean_of(error),
                "bound": float(fits["bound"][k]),
                "95 % intervals that hold": share(np.abs(off) <= NORMAL_95 * error),
            }
        )
    return rows


def _grid_rows(fits: Arrays, grid: Arrays) -> list[dict[str, Any]]:
    few = len(grid["cost"])
    best = grid["points"][grid["cost"].argmin(1)]
    found = {"grid": best, "gradient": fits["point"][:few]}
    return [
        {
            "search": name,
            "evaluations": int(evaluations),
            **{
                f"RMSE of {NAMES[k]} [{UNITS[k]}]": rmse_of(np.square(points[:, k] - TRUTH[k]))
                for k in range(3)
            },
            "log likelihood below the gradient's": mean_of(
                (cost - fits["cost"][:few]) * ROWS,
            ),
        }
        for (name, points), evaluations, cost in zip(
            found.items(),
            (grid["cost"].shape[1], fits["turns"]),
            (grid["cost"].min(1), fits["cost"][:few]),
            strict=True,
        )
    ]


def _grid_note(grid: Arrays) -> str:
    steps = ", ".join(f"{s:g} {u}" for s, u in zip(runs_of.STEPS, ("", "s", "s"), strict=True))
    return f"The grid is centred on the truth, which nobody knows; its steps: {steps}."


def _position_rows(errors: Arrays) -> list[dict[str, Any]]:
    titles = {
        "as stamped": "stamps believed, q tuned",
        "fitted": "q and latencies tuned on the run's own data",
        "known": "q and latencies known",
    }
    return [
        {
            "what": title,
            "RMSE [m]": rmse_of(errors[name]),
            "more than known [m]": None
            if name == "known"
            else paired(errors[name], errors["known"]),
        }
        for name, title in titles.items()
    ]


def _latency_arrays(fits: Arrays, grid: Arrays, errors: Arrays) -> xr.Dataset:
    by_parameter = ("run", "parameter")
    return xr.Dataset(
        {
            "estimate": xr.DataArray(fits["point"], dims=by_parameter),
            "standard_error": xr.DataArray(fits["error"], dims=by_parameter),
            "truth": xr.DataArray(TRUTH, dims="parameter"),
            "bound": xr.DataArray(fits["bound"], dims="parameter"),
            "grid_point": xr.DataArray(grid["points"], dims=("point", "parameter")),
            "grid_cost": xr.DataArray(grid["cost"], dims=("grid_run", "point")),
            "position_rmse": xr.DataArray(
                np.sqrt(np.stack(list(errors.values()))),
                dims=("what", "run"),
                coords={"what": list(errors)},
                attrs={"units": "m"},
            ),
        }
    ).assign_coords(parameter=list(NAMES), unit=("parameter", list(UNITS)))
