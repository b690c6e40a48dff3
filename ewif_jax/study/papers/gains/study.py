"""Figs. 1-3 of Yoder et al.: what an old measurement still weighs when they come irregularly; and
what the one-step methods make of it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import Array

from ewif_jax.analysis.gain_history import gain_history
from ewif_jax.analysis.merit import delayed_gain, steady_state_gain
from ewif_jax.scenarios.delays import poisson_times
from ewif_jax.study.papers.gains import figures
from ewif_jax.study.papers.late_loss.runs import relative_errors
from ewif_jax.study.shared.experiment import Experiment, Measured
from ewif_jax.study.shared.late import mean_of
from ewif_jax.types import Numbers

SETTLING = 400
AGES = (0, 1, 2, 4, 8)


class GainCase(NamedTuple):
    """One figure: the system F(dt), Q(dt), H with r = 1, the mean interval in seconds, how many
    measurements back the gains are followed, and the names of the state's components."""

    name: str
    interval: float
    F: Callable[[Any], Array]
    Q: Callable[[Any], Array]
    H: Array
    lag: int
    components: tuple[str, ...]


def gain_cases() -> tuple[GainCase, GainCase, GainCase]:
    """Random walks with a maneuvering index of 0.032 and 1, and position with velocity.

    Fig. 2 prints lambda = 1 and sigma_Q^2 = 0.5, hence an interval of 2 s. The noise of Fig. 3 is
    printed for one interval; here it grows with the interval.
    """
    still, one = (lambda dt: jnp.eye(1)), jnp.ones((1, 1))
    noise = jnp.asarray([[0.0, 0.0], [0.0, 0.01]])
    return (
        GainCase("fig1", 0.1, still, lambda dt: 0.01 * dt * one, one, 60, ("position",)),
        GainCase("fig2", 2.0, still, lambda dt: 0.5 * dt * one, one, 12, ("position",)),
        GainCase(
            "fig3",
            0.2,
            lambda dt: jnp.asarray([[1.0, 0.0], [0.0, 1.0]]).at[0, 1].set(dt),
            lambda dt: noise * dt / 0.2,
            jnp.asarray([[1.0, 0.0]]),
            40,
            ("position", "velocity"),
        ),
    )


def actual(case: GainCase, keys: Array) -> tuple[np.ndarray, np.ndarray]:
    """Ages (R, L+1) in seconds of the last measurements of each run, and their gains (R, L+1, n)
    in its last estimate."""
    steps = case.lag + SETTLING

    def one_run(key: Array) -> tuple[Array, Array]:
        time = poisson_times(key, case.interval, steps)
        between = jnp.diff(time)
        F, Q = jax.vmap(case.F)(between), jax.vmap(case.Q)(between)
        first = jnp.eye(case.H.shape[1])
        found = gain_history(F, case.H, Q, jnp.eye(1), first, case.lag)
        return time[-1] - time[::-1][: case.lag + 1], found.gain[-1, :, :, 0]

    ages, gains = jax.jit(jax.vmap(one_run))(keys)
    return np.asarray(ages), np.asarray(gains)


def closed_form(case: GainCase, ages: Numbers) -> np.ndarray:
    """The gain (..., n) of eq. (5), or (7) for a random walk, at `ages` in seconds."""
    system = case.F(case.interval), case.H, case.Q(case.interval), jnp.eye(1)
    if case.H.shape[1] == 1:
        k = float(steady_state_gain(*system)[0, 0])
        return (1 - k) ** (np.asarray(ages) / case.interval)[..., None] * k
    at = jax.vmap(lambda age: delayed_gain(*system, age / case.interval)[:, 0])
    return np.asarray(at(jnp.asarray(ages).reshape(-1))).reshape(*np.shape(ages), -1)


def run(experiment: Experiment) -> None:
    """Follows the gains, compares them with the closed forms, and draws."""
    runs = experiment.size(1000, 20)
    found, rows, arrays = {}, [], {}
    for number, case in enumerate(gain_cases()):
        with experiment.timed(case.name):
            keys = jax.random.split(experiment.key(number), runs)
            ages, gains = actual(case, keys)
            theory = closed_form(case, ages)
        found[case.name] = (case, ages, gains)
        rows += _gain_rows(case, ages, gains, theory)
        arrays |= _gain_arrays(case, ages, gains, theory)
    experiment.arrays("gains", xr.Dataset(arrays))
    draw = {"fig1": figures.low, "fig2": figures.typical, "fig3": figures.velocity}
    for name, (case, ages, gains) in found.items():
        experiment.figure(name, draw[name](case, ages, gains, closed_form))
    experiment.table(
        "gains",
        f"Gain of old measurements, {runs} Poisson sequences",
        rows,
        [
            "ratio: logarithm of actual over closed form at the actual age, averaged.",
            "fresh: average gain of the newest measurement, and the closed form's.",
        ],
    )
    with experiment.timed("one late measurement"):
        compared = relative_errors()
    experiment.table(
        "late_loss",
        "One late measurement: expected mean square error over the exact one",
        compared,
        [
            "Position, settled filter, q = r = 1, a measurement every second; the late one is of",
            "the middle of an interval. a1 and b1 take nothing from more than one",
            "update time back.",
        ],
    )
    experiment.finish()


def _gain_rows(
    case: GainCase, ages: np.ndarray, gains: np.ndarray, theory: np.ndarray
) -> list[dict]:
    rows = []
    for i, component in enumerate(case.components):
        row: dict[str, Any] = {
            "": case.name,
            "component": component,
            "fresh": mean_of(gains[:, 0, i]),
            "closed form": float(theory[0, 0, i]),
        }
        for age in AGES[1:]:
            if len(case.components) == 1:
                ratio = np.log(gains[:, age, i] / theory[:, age, i])
                row[f"ratio, {age} back"] = mean_of(ratio)
            else:
                row[f"ratio, {age} back"] = None
        difference = np.sqrt(np.mean((gains[..., i] - theory[..., i]) ** 2, 1))
        row["rms difference / fresh"] = _over_scale(mean_of(difference), theory[0, 0, i])
        rows.append(row)
    return rows


def _over_scale(measured: Measured, scale: float) -> Measured:
    return Measured(measured.value / scale, measured.error / scale)


def _gain_arrays(
    case: GainCase, ages: np.ndarray, gains: np.ndarray, theory: np.ndarray
) -> dict[str, xr.DataArray]:
    back, name = f"{case.name}_back", case.name
    dims = ("run", back, f"{name}_component")
    coords = {dims[2]: list(case.components)}
    return {
        f"{name}_age": xr.DataArray(ages, dims=dims[:2], attrs={"units": "s"}),
        f"{name}_gain": xr.DataArray(gains, dims=dims, coords=coords),
        f"{name}_closed_form": xr.DataArray(theory, dims=dims, coords=coords),
    }
