"""Monte Carlo studies: many simulated runs, measured without keeping the trajectories."""

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks, shown
from ewif_jax.estimator import Clock
from ewif_jax.fast.dependence import dependence, traced
from ewif_jax.fast.layout import Frozen, broadcast_prefix, equal_parts
from ewif_jax.moments import Moments, combined, shifted, standard_error
from ewif_jax.recipe import FromRecipe
from ewif_jax.scores import Score, average, scored, squared_error
from ewif_jax.types import Estimator, Gaussian, Measurement, Params, PyTree, RandomKey


class Simulation(NamedTuple):
    """One simulated run: the stream in arrival order, truth (T, k) at the report after each
    arrival, and the report times (T,), or None for the default of `run`."""

    measurements: Measurement
    truth: Array
    times: Array | None = None


RUN_STEPS = 2**20


class _ScenarioFields(NamedTuple):
    simulate: Callable[..., Simulation]
    prior: Gaussian | None
    t0: Any
    clock: Clock = "validity"
    params: Any = None


class Scenario(FromRecipe, _ScenarioFields):
    """A world to draw runs from: simulate(key) -> Simulation, what the filter is told at the
    start (prior, t0), and the clock of `run`.

    Or simulate(key, params) of parameters of the world, a dict of numbers by name, of which
    `params` are the defaults: other numbers compile nothing again.
    """


class Statistics(NamedTuple):
    """What a Monte Carlo study measured, for every metric by name.

    per_run (R,): average over the arrivals of a run; per_step (T,): average over the runs;
    per_step_se (T,): its standard error; missing (R,): arrivals left out, because the metric says
    NaN there (nothing known yet, nothing measured). What is infinite is not left out.
    """

    per_run: dict[str, np.ndarray]
    per_step: dict[str, np.ndarray]
    per_step_se: dict[str, np.ndarray]
    missing: dict[str, np.ndarray]

    def __repr__(self) -> str:
        return shown.as_text(self._lines())

    def _repr_html_(self) -> str:
        return shown.as_html(self._lines())

    def _lines(self) -> dict[str, str]:
        runs = max((len(x) for x in self.per_run.values()), default=0)
        lines = {"Statistics": f"{runs} runs; mean ± standard error, and the root of the mean"}
        for name in self.per_run:
            value, error = self.mean(name)
            text = f"{value:.5g} ± {error:.2g}"
            text += f", root {self.root(name)[0]:.5g}" if value >= 0 else ""
            left_out = int(np.sum(self.missing[name]))
            lines[name] = text + (f" ({left_out} arrivals left out)" if left_out else "")
        return lines

    def mean(self, name: str) -> tuple[float, float]:
        """The metric's average over runs, and its standard error."""
        values = self.per_run[name]
        values = values[~np.isnan(values)].astype(float)
        if values.size == 0:
            return float("nan"), float("nan")
        if values.size == 1 or not np.isfinite(values).all():
            return float(values.mean()), float("nan")
        return float(values.mean()), float(values.std(ddof=1) / np.sqrt(values.size))

    def root(self, name: str) -> tuple[float, float]:
        """The root of a mean square metric (an RMSE), and its standard error (delta method)."""
        value, error = self.mean(name)
        root = float(np.sqrt(value))
        return root, error / (2 * root) if root or np.isnan(error) else 0.0


def monte_carlo(
    estimator: Estimator,
    params: Params,
    scenario: Scenario,
    *,
    runs: int,
    key: RandomKey,
    metrics: Mapping[str, Score] | None = None,
    chunk: int | None = None,
    params_per_run: PyTree = False,
    devices: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Statistics:
    """Averages of `metrics` over simulated runs of an estimator.

    Args:
        estimator: any `Estimator`.
        params: its parameters; leaves marked in `params_per_run` have a leading axis of `runs`.
        scenario: where the runs come from.
        runs: how many.
        key: PRNG key; run i depends on it and on i alone, not on `chunk` or `devices`. Or typed
            keys (runs,), one for each run.
        metrics: scores by name (`ewif_jax.scores`); default {"squared_error": squared_error}.
        chunk: how many runs are in memory at once (default: at most 1024, and about a million
            arrivals together, so that memory grows neither with `runs` nor with the steps of a
            run); only scores of a chunk are kept, never its trajectories.
        params_per_run: True, False, or a pytree prefix of `params` of these.
        devices: how many local devices share a chunk (default all that divide it).
        progress: called with (runs done, runs) after each chunk.

    Raises:
        ValueError: runs < 2, chunk < 1, a key that is missing or is none, a metric that is no
            score, or what `run` refuses.
    """
    runs = checks.whole("runs", runs, 2)
    checks.require(key is not None, "key", "a PRNG key (jax.random.key(0))", None)
    checks.random_key(key, runs)
    if chunk is None:
        first = key[0] if _one_for_each(key) else key
        steps = jax.eval_shape(one_run(scenario), first).measurements.value.shape[0]
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
    moments: dict[str, Moments] = {}
    for index in equal_parts(runs, chunk):
        count = np.unique(index).size
        some = jax.tree.map(lambda x, f, i=index: x[i] if f else x, params, marked)
        # A run's keys come from its number, not from its place in a chunk: chunk and device count
        # change no number.
        keys, own_keys = run_keys(key, index)
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
        runwise, absent, found = jax.device_get(_summarise_scores(_at_hand(values)))
        per_run.append(runwise)
        missing.append(absent)
        for name, parts in found.items():
            added = shifted(*(np.asarray(x, float) for x in parts))
            moments[name] = combined(moments[name], added) if name in moments else added
        if progress is not None:
            progress(int(index[-1]) + 1, runs)
    per_step = {name: found.mean for name, found in moments.items()}
    errors = {name: standard_error(found) for name, found in moments.items()}
    return Statistics(_join_parts(per_run), per_step, errors, _join_parts(missing))


def _one_for_each(key: RandomKey) -> bool:
    """Whether these are typed keys along an axis of runs (a raw key has an axis of its own)."""
    return jnp.ndim(key) == 1 and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)


@jax.jit
def run_keys(key: Array, index: Array) -> tuple[Array, Array]:
    """For each run one key to simulate it and one to filter it."""
    if _one_for_each(key):
        keys = key[index]
    else:
        keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(index)
    return keys, jax.vmap(lambda k: jax.random.fold_in(k, 1))(keys)


def takes_params(scenario: Scenario) -> bool:
    """Whether it is simulate(key, params)."""
    if scenario.params is not None:
        return True
    try:
        signature = inspect.signature(scenario.simulate)
    except (TypeError, ValueError):  # what is written in C tells no arguments
        return False
    needed = [
        x
        for x in signature.parameters.values()
        if x.kind in (x.POSITIONAL_ONLY, x.POSITIONAL_OR_KEYWORD) and x.default is x.empty
    ]
    return len(needed) > 1


def one_run(scenario: Scenario) -> Callable[..., Simulation]:
    """Function (key, params) of one run, whether the scenario takes parameters or not; without
    params those of the scenario."""
    with_params = takes_params(scenario)

    def simulate(key: Array, params: Params = scenario.params) -> Simulation:
        if not with_params:
            return scenario.simulate(key)
        expected = "the parameters that its simulate(key, params) reads"
        checks.require(params is not None, "scenario.params", expected, None)
        return scenario.simulate(key, params)

    return simulate


def simulate_batch(scenario: Scenario, keys: Array, params: Params = None) -> Simulation:
    """One simulation per key, stacked on axis 0; what does not depend on the key stays shared
    (without that axis), so that filters compute with it once.

    Args:
        scenario: where the runs come from.
        keys: (R,) typed keys.
        params: of a scenario that takes parameters, in place of its own.
    """
    params = scenario.params if params is None else params
    # Which parts depend on the key is read off the equations: common times stay one array, and a
    # batch of filters then computes its gains once.
    flags = dependence(traced(one_run(scenario), keys[0], params), (True, _all_false(params)))
    # A scenario of a builder is compiled once for all that are equal; one made by hand may hold
    # arrays, which cannot be compared.
    source = scenario if scenario.recipe is not None else scenario.simulate
    return _simulate_runs(source, takes_params(scenario), keys, params, Frozen(flags))


def _all_false(tree: PyTree) -> Any:
    return jax.tree.map(lambda _: False, tree)


@partial(jax.jit, static_argnames=("source", "with_params", "flags"))
def _simulate_runs(
    source: Scenario | Callable[..., Simulation],
    with_params: bool,
    keys: Array,
    params: Params,
    flags: Frozen,
) -> Simulation:
    axes = jax.tree.map(lambda f: 0 if f else None, flags.tree)
    simulate = source.simulate if isinstance(source, Scenario) else source

    def drawn(key: Array) -> Simulation:
        return simulate(key, params) if with_params else simulate(key)

    return jax.vmap(drawn, out_axes=axes)(keys)


def _at_hand(values: dict[str, Array]) -> dict[str, Any]:
    """Values that several CPU devices have, on one: adding them up, the devices would wait for each
    other."""
    return jax.device_get(values) if jax.default_backend() == "cpu" else values


@jax.jit
def _summarise_scores(values: dict[str, Array]) -> tuple[dict, dict, dict]:
    """For each metric (R, T): its average over each run, how many values were left out, and of
    each step the sums that `shifted` reads."""
    is_score = jax.tree.map(lambda x: ~jnp.isnan(x), values)
    runwise = jax.tree.map(lambda x: average(x, 1), values)
    absent = jax.tree.map(lambda k: jnp.sum(~k, 1), is_score)
    return runwise, absent, jax.tree.map(step_sums, values, is_score)


def step_sums(values: Array, is_score: Array) -> tuple[Array, Array, Array, Array]:
    """Of each step (T,): the count, the mean, and the sum and square sum of the distances from it
    (the mean is rounded, so the first is not quite 0)."""
    count, mean = jnp.sum(is_score, 0), average(values, 0)
    apart = jnp.where(is_score, values - mean[None], 0)
    return count, mean, jnp.sum(apart, 0), jnp.sum(jnp.square(apart), 0)


def _join_parts(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
