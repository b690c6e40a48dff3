"""How well measurements are predicted from the earlier ones: losses for tuning, and a report."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import scores
from ewif_jax.analysis.consistency import nis
from ewif_jax.batch import Step, run_batch
from ewif_jax.charges import Cost, density_cost, length_cost, squared_cost
from ewif_jax.charging import value_charging
from ewif_jax.scores import average
from ewif_jax.study.shared.experiment import Measured
from ewif_jax.study.track.method import TrackMethod
from ewif_jax.study.track.tracks import Tracks
from ewif_jax.types import Measurement, Params, Status

WIDTH = 0.1
"""Of the smooth median, in units of the logarithm of the error."""


def smooth_median(length: Array) -> Array:
    r"""A differentiable median of positive numbers; NaN are left out.

    The m with :math:`\sum_i \sigma((\log m - \log x_i) / w) = N / 2`, w = `WIDTH`: the median for
    w -> 0. Its gradient is the average of the gradients of the x_i near m, so what the worst
    predictions do does not matter.
    """
    is_finite = jnp.isfinite(length)
    logs = jnp.log(jnp.where(is_finite, length, 1) + jnp.finfo(length.dtype).tiny)
    fixed = lax.stop_gradient(logs)
    count = jnp.maximum(jnp.sum(is_finite), 1)

    def below(m: Array, logs: Array) -> Array:
        return jnp.sum(jnp.where(is_finite, jax.nn.sigmoid((m - logs) / WIDTH), 0)) / count

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = (bounds[0] + bounds[1]) / 2
        low = below(middle, fixed) < 0.5
        return jnp.where(low, middle, bounds[0]), jnp.where(low, bounds[1], middle)

    ends = (
        jnp.min(fixed, where=is_finite, initial=jnp.inf),
        jnp.max(fixed, where=is_finite, initial=-jnp.inf),
    )
    low, high = lax.fori_loop(0, 60, halve, ends)
    m = (low + high) / 2
    slope = jax.grad(below)(m, fixed)
    # one Newton step that does not move m, through which the implicit derivative flows
    return jnp.exp(m - (below(m, logs) - below(m, fixed)) / slope)


LOSSES: dict[str, tuple[scores.Score, Cost, Callable[[Array], Array]]] = {
    "median": (scores.robust_innovation, length_cost, smooth_median),
    "robust": (scores.robust_innovation, length_cost, average),
    "squared": (scores.squared_innovation, squared_cost, lambda x: jnp.sqrt(average(x))),
    "likelihood": (scores.negative_log_likelihood, density_cost, average),
}


Batches = Sequence[tuple[np.ndarray, Measurement]]
"""which tracks, and their measurements (G, T, ...)"""


def loss(kind: str, method: TrackMethod, batches: Batches) -> Callable[[Any], Array]:
    """The loss of the tunable parameter: params -> (), over the arrivals that params["counted"]
    (G, T) of each batch says (1 or 0); those that the filter does not predict are charged."""
    score, cost, finish = LOSSES[kind]
    charged = [
        value_charging(
            method.estimator,
            measurements,
            cost,
            "charge",
            {"prior": method.prior_of(tracks), "t0": 0.0},
        )
        for tracks, measurements in batches
    ]

    def loss_of_params(params: Params) -> Array:
        counted = params["counted"]
        given = {**method.params, **{k: x for k, x in params.items() if k != "counted"}}
        every = [
            jnp.where(here > 0, charging.scored(given, None, score), jnp.nan).ravel()
            for charging, here in zip(charged, counted, strict=True)
        ]
        return finish(jnp.concatenate(every))

    return loss_of_params


def filtered(
    method: TrackMethod, params: Params, tracks: Tracks, batches: Batches
) -> dict[str, np.ndarray]:
    """Estimates and diagnostics (N, ...) after every row, one batched call for tracks of like
    length."""
    every = []
    for some, measurements in batches:
        found = run_batch(
            method.estimator,
            params,
            measurements,
            prior=method.prior_of(some),
            t0=0.0,
            observe=_seen_row,
            devices=1,
        )
        every.append({name: np.asarray(x) for name, x in found.items()})
    arrays = {name: tracks.flat([found[name] for found in every]) for name in every[0]}
    return {**arrays, "nis": arrays["nis"] / np.maximum(tracks.mask.sum(-1), 1)}


def predicted(found: dict[str, np.ndarray]) -> np.ndarray:
    """Which rows (N,) were predicted and used."""
    return (found["status"] <= Status.LATE_USED) & np.isfinite(found["error"])


def report(
    found: dict[str, np.ndarray], row: np.ndarray, used: np.ndarray, seed: int
) -> dict[str, Any]:
    """Median and RMSE of the one-step prediction errors in metres, and NIS per component, over the
    rows `used` (N,), with standard errors by resampling tracks."""
    cuts = np.searchsorted(row[used], np.arange(1, row.max() + 1))
    errors, nis_of = (np.split(found[name][used], cuts) for name in ("error", "nis"))
    return {
        "median error [m]": _resampled_statistic(errors, np.median, seed),
        "RMSE [m]": _resampled_statistic(errors, lambda x: np.sqrt(np.mean(x**2)), seed),
        "NIS per component": _resampled_statistic(nis_of, np.mean, seed),
        "scored": int(used.sum()),
    }


def _seen_row(step: Step, _: None) -> dict[str, Array]:
    info = step.info
    return {
        "mean": step.mean,
        "sd": jnp.sqrt(jnp.diagonal(step.cov)),
        "innovation": info.innovation,
        "error": jnp.sqrt(jnp.sum(jnp.square(info.innovation))),
        "nis": nis(info),
        "status": info.status,
    }


def _resampled_statistic(
    groups: list[np.ndarray], statistic: Callable[[Any], Any], seed: int
) -> Measured:
    groups = [group for group in groups if group.size]
    if not groups:
        return Measured(np.nan, np.nan)
    value = float(statistic(np.concatenate(groups)))
    if len(groups) == 1:
        return Measured(value, np.nan)
    draws = np.random.default_rng(seed).integers(len(groups), size=(200, len(groups)))
    again = [statistic(np.concatenate([groups[i] for i in draw])) for draw in draws]
    return Measured(value, float(np.std(again, ddof=1)))
