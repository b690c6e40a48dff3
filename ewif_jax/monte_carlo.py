"""Monte Carlo studies: many simulated runs, measured without keeping the trajectories."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.estimator import Clock
from ewif_jax.fast.dependence import dependence, traced
from ewif_jax.fast.layout import Frozen, broadcast_prefix
from ewif_jax.recipe import FromRecipe
from ewif_jax.scores import Score, scored, squared_error
from ewif_jax.types import Estimator, Gaussian, Measurement


class Simulation(NamedTuple):
    """One simulated run: the stream in arrival order, truth (T, k) at the report after each
    arrival, and the report times (T,), or None for the default of `run`."""

    measurements: Measurement
    truth: Array
    times: Array | None = None


RUN_STEPS = 2**20


class _Scenario(NamedTuple):
    simulate: Callable[[Array], Simulation]
    prior: Gaussian | None
    t0: Any
    clock: Clock = "validity"


class Scenario(FromRecipe, _Scenario):
    """A world to draw runs from: simulate(key) -> Simulation, what the filter is told at the
    start (prior, t0), and the clock of `run`."""


class Statistics(NamedTuple):
    """What a Monte Carlo study measured, for every metric by name.

    per_run (R,): average over the arrivals of a run; per_step (T,): average over the runs;
    per_step_se (T,): its standard error; missing (R,): arrivals that could not be measured (NaN).
    """

    per_run: dict[str, np.ndarray]
    per_step: dict[str, np.ndarray]
    per_step_se: dict[str, np.ndarray]
    missing: dict[str, np.ndarray]

    def mean(self, name: str) -> tuple[float, float]:
        """The metric's average over runs, and its standard error."""
        values = self.per_run[name]
        values = values[np.isfinite(values)]
        return float(values.mean()), float(values.std(ddof=1) / np.sqrt(max(values.size, 1)))

    def root(self, name: str) -> tuple[float, float]:
        """The root of a mean square metric (an RMSE), and its standard error (delta method)."""
        value, error = self.mean(name)
        root = float(np.sqrt(value))
        return root, error / (2 * root) if root else 0.0


def monte_carlo(
    estimator: Estimator,
    params: Any,
    scenario: Scenario,
    *,
    runs: int,
    key: Any,
    metrics: Mapping[str, Score] | None = None,
    chunk: int | None = None,
    params_per_run: Any = False,
    devices: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Statistics:
    """Averages of `metrics` over simulated runs of an estimator.

    Args:
        estimator: any `Estimator`.
        params: its parameters; leaves marked in `params_per_run` have a leading axis of `runs`.
        scenario: where the runs come from.
        runs: how many.
        key: PRNG key; run i depends on it and on i alone, not on `chunk` or `devices`.
        metrics: scores by name (`ewif_jax.scores`); default {"squared_error": squared_error}.
        chunk: how many runs are in memory at once (default: at most 1024, and about a million
            arrivals together, so that memory grows neither with `runs` nor with the steps of a
            run); only scores of a chunk are kept, never its trajectories.
        params_per_run: True, False, or a pytree prefix of `params` of these.
        devices: how many local devices share a chunk (default all that divide it).
        progress: called with (runs done, runs) after each chunk.

    Raises:
        ValueError: runs < 2, chunk < 1, a missing key, or what `run` refuses.
    """
    runs = checks.whole("runs", runs, 2)
    checks.needs_key(key, "monte_carlo")
    if chunk is None:
        steps = jax.eval_shape(scenario.simulate, key).measurements.value.shape[0]
        parts = -(-runs // min(1024, max(RUN_STEPS // steps, 1)))
        chunk = -(-runs // parts)
    chunk = min(checks.whole("chunk", chunk, 1), runs)
    metrics = dict(metrics or {"squared_error": squared_error})
    marked = broadcast_prefix(params_per_run, params)
    for leaf, per_run in zip(jax.tree.leaves(params), jax.tree.leaves(marked), strict=True):
        if per_run:
            checks.require(
                jnp.shape(leaf)[:1] == (runs,), "params", f"{runs} runs", jnp.shape(leaf)
            )
    per_run: list[dict[str, np.ndarray]] = []
    missing: list[dict[str, np.ndarray]] = []
    moments: Any = None
    for begin in range(0, runs, chunk):
        count = min(chunk, runs - begin)
        # Filled up with repetitions, so that the last chunk is not compiled again.
        index = np.minimum(np.arange(begin, begin + chunk), runs - 1)
        some = jax.tree.map(lambda x, f, i=index: x[i] if f else x, params, marked)
        keys, own_keys = _keys(key, index)
        simulation = simulate_batch(scenario, keys)
        values = scored(
            estimator,
            some,
            simulation.measurements,
            simulation.truth,
            scores=metrics,
            prior=scenario.prior,
            t0=scenario.t0,
            times=simulation.times,
            clock=scenario.clock,
            key=own_keys,
            params_per_run=params_per_run,
            devices=devices,
        )
        values = {name: x[:count] for name, x in values.items()}
        runwise, absent, sums = jax.device_get(_summarise(_at_hand(values)))
        per_run.append(runwise)
        missing.append(absent)
        moments = sums if moments is None else jax.tree.map(np.add, moments, sums)
        if progress is not None:
            progress(begin + count, runs)
    per_step, per_step_se = {}, {}
    for name, (count, total, square) in moments.items():
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.where(count > 0, total / count, np.nan)
            variance = np.maximum(square / count - mean**2, 0) * count / np.maximum(count - 1, 1)
            per_step[name], per_step_se[name] = mean, np.sqrt(variance / count)
    return Statistics(_join(per_run), per_step, per_step_se, _join(missing))


@jax.jit
def _keys(key: Array, index: Array) -> tuple[Array, Array]:
    """For each run one key to simulate it and one to filter it."""
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(index)
    return keys, jax.vmap(lambda k: jax.random.fold_in(k, 1))(keys)


def simulate_batch(scenario: Scenario, keys: Array) -> Simulation:
    """One simulation per key, stacked on axis 0; what does not depend on the key stays shared
    (without that axis), so that filters compute with it once."""
    flags = dependence(traced(scenario.simulate, keys[0]), True)
    # A scenario of a builder is compiled once for all that are equal; one made by hand may hold
    # arrays, which cannot be compared.
    source = scenario.simulate if scenario.recipe is None else scenario
    return _simulate(source, keys, Frozen(flags))


@partial(jax.jit, static_argnames=("source", "flags"))
def _simulate(
    source: Scenario | Callable[[Array], Simulation], keys: Array, flags: Frozen
) -> Simulation:
    axes = jax.tree.map(lambda f: 0 if f else None, flags.tree)
    simulate = source.simulate if isinstance(source, Scenario) else source
    return jax.vmap(simulate, out_axes=axes)(keys)


def _at_hand(values: dict[str, Array]) -> dict[str, Any]:
    """Values that several CPU devices have, on one: adding them up, the devices would wait for each
    other."""
    return jax.device_get(values) if jax.default_backend() == "cpu" else values


@jax.jit
def _summarise(values: dict[str, Array]) -> tuple[dict, dict, dict]:
    known = jax.tree.map(jnp.isfinite, values)
    filled = jax.tree.map(lambda x, k: jnp.where(k, x, 0), values, known)
    count = jax.tree.map(lambda k: jnp.sum(k, 1), known)
    runwise = jax.tree.map(
        lambda x, c: jnp.where(c > 0, jnp.sum(x, 1) / jnp.maximum(c, 1), jnp.nan), filled, count
    )
    absent = jax.tree.map(lambda k: jnp.sum(~k, 1), known)
    sums = {
        name: (jnp.sum(known[name], 0), jnp.sum(x, 0), jnp.sum(jnp.square(x), 0))
        for name, x in filled.items()
    }
    return runwise, absent, sums


def _join(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
