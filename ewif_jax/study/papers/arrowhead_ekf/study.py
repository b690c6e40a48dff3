"""The extended Kalman filter on the arrowhead: section 4.3 and Fig. 10 of Yoder et al."""

import math
from bisect import bisect_right
from typing import Any

import jax
import numpy as np
import xarray as xr

from ewif_jax.estimators.extended import extended
from ewif_jax.lab.timing import timed
from ewif_jax.monte_carlo import Simulation, simulate_batch
from ewif_jax.oosm.replay import replay
from ewif_jax.oosm.selective import selective
from ewif_jax.scenarios.arrowhead import arrowhead_ekf, arrowhead_ekf_model
from ewif_jax.study.shared.experiment import Experiment
from ewif_jax.study.shared.figures import OTHER, label, study_canvas
from ewif_jax.study.shared.late import DROPPED, mean_of, rmse_of, rmses_of, sweep

LIMITS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 15.0, math.inf)
"""seconds; delays are whole ones, and what is older than the limit is dropped"""


def run(experiment: Experiment) -> None:
    """Filters with each maximum delay, counts the work, and draws; see the module's first line."""
    quick = experiment.options.quick
    runs, steps = experiment.size(30, 2), 200 if quick else 2000
    limits = (0.0, 5.0, math.inf) if quick else LIMITS
    scenario = arrowhead_ekf(steps=steps)
    with experiment.timed("simulation"):
        batch = simulate_batch(scenario, jax.random.split(experiment.key(0), runs))
    refiltered = steps_again(np.asarray(batch.measurements.time), limits)
    found = [
        experiment.piece(
            f"limit-{limit}", lambda x=limit: _limited_delay(experiment, scenario, batch, x)
        )
        for limit in limits
    ]
    squared = np.stack([one["squared_error"] for one in found])
    used = np.stack([one["late_used"] for one in found])
    seconds = np.asarray([1e6 * float(one["seconds"]) / (runs * steps) for one in found])
    slots = [int(one["slots"]) for one in found]
    least, most = rmse_of(squared[-1]).value, rmse_of(squared[0]).value
    rows = [
        {
            "maximum delay [s]": limit,
            "RMSE [m]": rmse_of(mse),
            "excess over no limit": f"{100 * (rmse_of(mse).value - least) / (most - least):.0f} %",
            "late updates per measurement": mean_of(late),
            "steps filtered again per measurement": mean_of(again),
            "buffer": size,
            "run time [µs]": time,
        }
        for limit, mse, late, again, size, time in zip(
            limits, squared, used, refiltered, slots, seconds, strict=True
        )
    ]
    axis = {"limit": ("limit", list(limits), {"units": "s"})}

    def array(x: np.ndarray, **attrs: str) -> xr.DataArray:
        return xr.DataArray(x, dims=("limit", "run")[: x.ndim], coords=axis, attrs=attrs)

    experiment.arrays(
        "arrowhead_ekf",
        xr.Dataset(
            {
                "rmse_of_run": array(np.sqrt(squared), units="m"),
                "late_used": array(used, units="1"),
                "filtered_again": array(refiltered, units="1"),
                "run_time": array(seconds, units="microseconds per measurement"),
            }
        ),
    )
    experiment.figure("fig10", _draw_figure(np.asarray(limits), squared, refiltered, seconds))
    experiment.table(
        "arrowhead_ekf",
        f"EKF with exact replay, {runs} runs of {steps} measurements",
        rows,
        [
            "A compiled program with a fixed buffer does the same work whatever it drops. What the",
            "limit saves is the buffer: run time is that of a program whose buffer just covers it,",
            "per measurement, all runs in one batch. Steps filtered again is what a program",
            "without fixed shapes would have to do.",
            "With everything used the expectation is 15.79 ± 0.04 m; 30 runs scatter around it.",
        ],
    )
    experiment.finish()


def steps_again(times: np.ndarray, limits: tuple[float, ...]) -> np.ndarray:
    """How many steps (V, R) a filter that goes back has to repeat, per measurement: for each late
    one within the limit, those newer ones that the filter has taken."""
    found = np.zeros((len(limits), len(times)))
    for i, limit in enumerate(limits):
        for j, time in enumerate(times):
            newest = np.maximum.accumulate(time)
            taken: list[float] = []
            for t, top in zip(time.tolist(), newest.tolist(), strict=True):
                if top - t <= limit:
                    place = bisect_right(taken, t)
                    found[i, j] += len(taken) - place
                    taken.insert(place, t)
    return found / times.shape[1]


def _limited_delay(
    experiment: Experiment, scenario: Any, batch: Simulation, limit: float
) -> dict[str, Any]:
    """One maximum delay, with a buffer that just covers it; the time is the best of three."""
    stamps = np.asarray(batch.measurements.time)
    longest = float(np.max(np.maximum.accumulate(stamps, axis=1) - stamps))
    slots = max(math.ceil(min(limit, longest)), 1)
    estimator = selective(
        replay(extended(arrowhead_ekf_model()), slots, width=4), lambda p: p["limit"]
    )
    label = f"maximum delay {limit:g} s"

    def measured() -> dict[str, np.ndarray]:
        return sweep(
            estimator,
            {"limit": np.asarray([limit + 0.5])},
            batch,
            prior=scenario.prior,
            t0=0.0,
            chunk=experiment.options.chunk,
        )

    with experiment.timed(label):
        found = measured()
    times = []
    for _ in range(3):
        with timed() as timing:
            measured()
        times.append(timing.run)
    first = {name: x[0] for name, x in found.items()}
    return {**first, "slots": slots, "seconds": min(times)}


def _draw_figure(
    limits: np.ndarray, squared: np.ndarray, refiltered: np.ndarray, seconds: np.ndarray
) -> Any:
    figure, axes = study_canvas(1, 2, width=11, height=4.2)
    inside = np.isfinite(limits)
    values, errors = rmses_of(squared)
    spread = np.sqrt(squared).std(1, ddof=1)
    axes[0].fill_between(
        limits[inside],
        (values - spread)[inside],
        (values + spread)[inside],
        color=OTHER,
        alpha=0.2,
        linewidth=0,
        label="± 1 standard deviation of a run",
    )
    axes[0].errorbar(
        limits[inside],
        values[inside],
        errors[inside],
        fmt="o-",
        color=OTHER,
        capsize=3,
        markersize=4,
        label="mean ± 1 s.e.",
    )
    axes[0].axhline(values[-1], color=DROPPED, linewidth=1, label="everything used")
    axes[0].legend(frameon=False, fontsize="small")
    label(axes[0], "maximum delay [s]", "RMSE [m]", "EKF with exact replay")
    work = np.asarray([mean_of(x) for x in refiltered])
    axes[1].errorbar(
        limits[inside],
        work[inside, 0],
        work[inside, 1],
        fmt="o-",
        color=OTHER,
        capsize=3,
        markersize=4,
        label="steps filtered again",
    )
    axes[1].legend(frameon=False, fontsize="small", loc="upper left")
    label(axes[1], "maximum delay [s]", "steps per measurement [1]", "What it costs")
    other = axes[1].twinx()
    other.plot(
        limits[inside],
        seconds[inside],
        "s--",
        color=DROPPED,
        markersize=4,
        label="run time, buffer as long as the limit",
    )
    other.set_ylabel("run time per measurement [µs]")
    other.set_ylim(bottom=0)
    other.legend(frameon=False, fontsize="small", loc="lower right")
    return figure
