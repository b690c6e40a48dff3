"""The sine experiment of Shulami & Sigalov, section V-C and Fig. 1, and its optimum by gradient."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from jax import Array

from ewif_jax.analysis.expected import expected_mse
from ewif_jax.analysis.merit import random_walk_gain
from ewif_jax.estimator import run as run_filter
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.information import information
from ewif_jax.losses import rmse_loss
from ewif_jax.monte_carlo import monte_carlo, simulate_batch
from ewif_jax.scenarios.sine import sine, sine_model, sine_signal
from ewif_jax.streams import stream
from ewif_jax.study.papers.sine import figures as sine_figures
from ewif_jax.study.papers.two_sided import runs as two_sided
from ewif_jax.study.shared.experiment import Experiment, Measured
from ewif_jax.study.shared.folder import Arrays
from ewif_jax.transforms import positive
from ewif_jax.tuning import tune
from ewif_jax.types import Estimator

DT, VARIANCE = 0.1, 0.5
PUBLISHED_TAU, PUBLISHED_NOISE = 0.5, 0.1
BLOCK = 16
BEHIND = 5
"""samples of the fixed lag"""
SETTINGS = ("published", "tuned on samples", "exact optimum")


class Filter(NamedTuple):
    """One of the two filters: its parameter, its exact RMSE (see `exact_rmse`), the published value
    and RMSE, where the gradient starts from, and the range of the curve."""

    name: str
    estimator: Estimator
    parameter: str
    unit: str
    exact: Callable[[Array], Array]
    published: float
    printed: float
    starts: tuple[float, float]
    span: tuple[float, float]


def filters() -> tuple[Filter, Filter]:
    """The EWIF, and the Kalman filter that the first sample starts."""
    model = sine_model(VARIANCE, DT)

    def described(name: str, estimator: Estimator, parameter: str, *rest: Any) -> Filter:
        unit = {"tau": "s", "sigma_w": "m"}[parameter]
        return Filter(name, estimator, parameter, unit, exact_rmse(estimator, parameter), *rest)

    exponential, noisy = ewif(model, tau=lambda p: p["tau"]), information(model)
    return (
        described("EWIF", exponential, "tau", PUBLISHED_TAU, 0.31, (0.05, 5.0), (0.05, 5.0)),
        described("KF", noisy, "sigma_w", PUBLISHED_NOISE, 0.33, (0.01, 1.0), (0.02, 1.0)),
    )


def exact_rmse(estimator: Estimator, parameter: str) -> Callable[[Array], Array]:
    """Parameter values (k,) -> root of the exact expected mean square error over time (k,)."""

    def rmse(value: Array) -> Array:
        time, truth = sine_signal(dt=DT)
        mse = expected_mse(
            estimator,
            {parameter: value},
            stream(time, truth),
            truth,
            noise_cov=VARIANCE,
            prior=None,
            t0=0.0,
        )
        return jnp.sqrt(jnp.mean(mse))

    return jax.jit(jax.vmap(rmse))


def in_blocks(exact: Callable[[Array], Array], points: np.ndarray) -> np.ndarray:
    """`exact` of any number of points, `BLOCK` at a time: one compiled program does for all."""
    blocks = np.resize(points, (-(-len(points) // BLOCK), BLOCK))
    found = [np.asarray(exact(jnp.asarray(block))) for block in blocks]
    return np.concatenate(found)[: len(points)]


def run(experiment: Experiment) -> None:
    """Tunes both filters, measures them on fresh runs, and compares with the exact error."""
    found, series, rows, notes = {}, {}, [], []
    pair = filters()
    for one in pair:
        tuned = experiment.piece(f"{one.name}-tuned", lambda f=one: _tuned_settings(experiment, f))
        measured = experiment.piece(
            f"{one.name}-measured", lambda f=one, t=tuned: _measured_errors(experiment, f, t)
        )
        found[one.name] = (one, tuned | measured)
        series |= _labelled_arrays(one, found[one.name][1])
        rows += _setting_rows(one, found[one.name][1])
        notes += [
            f"{one.name}: the gradient of the exact error leads from {start} to {end:.4f}"
            for start, end in zip(one.starts, tuned["optimum"], strict=True)
        ]
    example = _example_track(experiment, pair)
    notes += _equivalent_tau(experiment, pair[0], float(found["KF"][1]["exact"][0]))
    experiment.arrays("sine", xr.Dataset({**series, **example}))
    experiment.figure("tracks", sine_figures.sine_tracks(example))
    experiment.figure("rmse", sine_figures.loss_curves(found))
    experiment.figure("tuning", sine_figures.tuning_histories(found))
    runs = experiment.size(10_000, 500)
    _smoother_table(experiment)
    experiment.table("sine", f"Sine: {runs} runs of 101 samples, RMSE in m", rows, notes)
    experiment.finish()


def _smoother_table(experiment: Experiment) -> None:
    """A table of the filter, its fixed lag and the two-sided estimate."""
    runs = experiment.size(2000, 200)
    taus = np.asarray([0.2, 0.3, 0.4, PUBLISHED_TAU, 0.6, 0.8, 1.0, 1.3])

    def compute() -> dict[str, Any]:
        with experiment.timed("smoothers"):
            batch = simulate_batch(
                sine(dt=DT, r=VARIANCE), jax.random.split(experiment.key(4), runs)
            )
            return two_sided.compared_means(sine_model(VARIANCE, DT), taus, batch, steps=BEHIND)

    experiment.table(
        "smoothers",
        f"EWIF, filtering and smoothing: {runs} runs, RMSE in m",
        two_sided.table_rows(experiment.piece("smoothers", compute), taus, list(taus).index(0.5)),
        [
            f"fixed lag: {BEHIND * DT:g} s. two-sided: all the samples of the run. above: run by",
            "run, best tau. Scored at the times that all three report.",
        ],
    )


DESCENT: Any = {"method": "adam", "transforms": positive()}
"""Small steps, which make a path to draw; sigma_w counts squared, so its sign is not found."""


def _tuned_settings(experiment: Experiment, one: Filter) -> dict[str, Any]:
    """Gradient descent on a training batch, and on the exact error from both starts at once: the
    loss is their mean and the optimizer treats each number by itself, so neither sees the other."""
    quick = experiment.options.quick
    steps, name = 200, one.parameter
    keys = jax.random.split(experiment.key(1), 64 if quick else 256)
    label = f"{one.name}: tuning on {len(keys)} sampled runs"
    with experiment.timed(label), experiment.progress(label) as report:
        training = simulate_batch(sine(dt=DT, r=VARIANCE), keys)
        data = training.measurements, training.truth
        loss = rmse_loss(one.estimator, *data, prior=None, t0=0.0)
        start = {name: np.asarray(one.starts[1])}
        sampled = tune(loss, start, **DESCENT, steps=steps, progress=report)
    label = f"{one.name}: tuning on the exact error"
    with experiment.timed(label), experiment.progress(label) as report:
        exact = tune(
            lambda params: jnp.mean(one.exact(params[name])),
            {name: jnp.asarray(one.starts)},
            **DESCENT,
            steps=steps,
            progress=report,
        )
    return {
        "sampled": sampled.params[name],
        "sampled_path": sampled.history["params"][name],
        "sampled_loss": sampled.history["loss"],
        "optimum": exact.params[name],
        "path": exact.history["params"][name],
    }


def _measured_errors(experiment: Experiment, one: Filter, tuned: Arrays) -> dict[str, Any]:
    """RMSE of the three settings and along the curve, on runs that the tuning has not seen, and
    the exact RMSE there and along the descents."""
    grid = np.geomspace(*one.span, 5 if experiment.options.quick else 9)
    value = np.array([one.published, tuned["sampled"], tuned["optimum"][0], *grid])
    scenario, statistics = sine(dt=DT, r=VARIANCE), []
    label = f"{one.name}: Monte Carlo"
    with experiment.timed(label), experiment.progress(label) as report:
        for number in value:
            statistics.append(
                monte_carlo(
                    one.estimator,
                    {one.parameter: jnp.asarray(number)},
                    scenario,
                    runs=experiment.size(10_000, 500),
                    key=experiment.key(2),
                    chunk=experiment.options.chunk or 1000,
                )
            )
            report(len(statistics), len(value))
    fine = np.geomspace(*one.span, 60)
    with experiment.timed(f"{one.name}: exact expected error"):
        points = np.concatenate([value, fine, tuned["path"].ravel()])
        exact = in_blocks(one.exact, points)
    at_value, at_fine, at_path = np.split(exact, [len(value), len(value) + len(fine)])
    roots = np.asarray([s.root("squared_error") for s in statistics])
    single = np.sqrt(np.stack([s.per_run["squared_error"] for s in statistics[:3]]))
    return {
        "value": value,
        "rmse": roots[:, 0],
        "rmse_se": roots[:, 1],
        "exact": at_value,
        "single": single,
        "fine": fine,
        "fine_exact": at_fine,
        "path_exact": at_path.reshape(tuned["path"].shape),
    }


def _setting_rows(one: Filter, found: Arrays) -> list[dict[str, Any]]:
    low, high = np.quantile(found["single"], [0.05, 0.95], axis=1)
    return [
        {
            "filter": one.name,
            "setting": setting,
            "parameter": one.parameter,
            "value": f"{found['value'][i]:.4f}",
            "Monte Carlo RMSE": Measured(found["rmse"][i], found["rmse_se"][i]),
            "exact expected RMSE": f"{found['exact'][i]:.4f}",
            "90 % of single runs": f"{low[i]:.2f} to {high[i]:.2f}",
            "paper (one run)": one.printed if i == 0 else None,
        }
        for i, setting in enumerate(SETTINGS)
    ]


def _example_track(experiment: Experiment, pair: tuple[Filter, Filter]) -> dict[str, xr.DataArray]:
    """One realisation, filtered with the published settings."""
    with experiment.timed("one realisation"):
        seen, truth, _ = sine(dt=DT, r=VARIANCE).simulate(experiment.key(3))
        time = {"time": ("time", np.asarray(seen.time), {"units": "s"})}
        series = {"truth": truth, "measured": seen.value}
        for one in pair:
            params = {one.parameter: one.published}
            series[one.name] = run_filter(one.estimator, params, seen, prior=None, t0=0.0).mean
    return {
        name: xr.DataArray(np.asarray(x)[:, 0], dims="time", coords=time, attrs={"units": "m"})
        for name, x in series.items()
    }


def _equivalent_tau(experiment: Experiment, exponential: Filter, rmse: float) -> list[str]:
    """The tau that behaves like the published process noise: by equal steady gain, and by equal
    expected RMSE (the root nearby, on the rising side of the curve)."""
    params = {"sigma_w": PUBLISHED_NOISE}

    def compute() -> dict[str, Any]:
        gain = float(random_walk_gain(params["sigma_w"] / np.sqrt(VARIANCE)))
        by_gain = -DT / np.log1p(-gain)
        low, high = by_gain / 1.5, by_gain * 1.5
        with experiment.timed("equivalent tau"):
            for _ in range(6):
                grid = np.linspace(low, high, BLOCK)
                above = int(np.argmax(in_blocks(exponential.exact, grid) > rmse))
                low, high = grid[max(above - 1, 0)], grid[above]
        return {"tau": np.asarray([by_gain, (low + high) / 2])}

    taus = experiment.piece("equivalent", compute)["tau"]
    criteria = ("equal steady gain", "equal expected RMSE")
    frame = pd.DataFrame({"criterion": criteria, **params, "equivalent_tau_s": taus})
    experiment.csv("equivalent", frame)
    return [
        f"sigma_w = {params['sigma_w']} is equivalent to tau = {tau:.4f} s by {criterion}"
        for tau, criterion in zip(taus, criteria, strict=True)
    ]


def _labelled_arrays(one: Filter, found: Arrays) -> dict[str, xr.DataArray]:
    """What was found for one filter, as labelled arrays."""
    name, rmse = one.name, {"units": "m", "long_name": f"{one.name} RMSE"}
    given = {"units": one.unit, "long_name": one.parameter}
    value, fine = f"{name}_{one.parameter}", f"{name}_{one.parameter}_curve"
    descent = f"{name}_descent"
    starts = {descent: [f"from {start}" for start in one.starts]}

    def along(dim: str, at: str, x: str) -> xr.DataArray:
        return xr.DataArray(found[x], dims=dim, coords={dim: (dim, found[at], given)}, attrs=rmse)

    return {
        f"{name}_rmse": along(value, "value", "rmse"),
        f"{name}_rmse_se": along(value, "value", "rmse_se"),
        f"{name}_rmse_exact": along(value, "value", "exact"),
        f"{name}_rmse_exact_curve": along(fine, "fine", "fine_exact"),
        f"{name}_rmse_of_run": xr.DataArray(
            found["single"], dims=("setting", "run"), coords={"setting": list(SETTINGS)}, attrs=rmse
        ),
        f"{name}_sampled_{one.parameter}": xr.DataArray(
            found["sampled_path"], dims="step", attrs=given
        ),
        f"{name}_sampled_loss": xr.DataArray(found["sampled_loss"], dims="step", attrs=rmse),
        f"{name}_descent_{one.parameter}": xr.DataArray(
            found["path"], dims=("step", descent), coords=starts, attrs=given
        ),
        f"{name}_descent_rmse": xr.DataArray(
            found["path_exact"], dims=("step", descent), coords=starts, attrs=rmse
        ),
    }
