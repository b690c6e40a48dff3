"""Runs one after another, on every core: for filters that keep a core busy by themselves."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jax import lax

from ewif_jax.estimator import Clock, run
from ewif_jax.fast.layout import equal_part, equal_parts, over_devices
from ewif_jax.lab.timing import timed
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.study.shared.experiment import Measured
from ewif_jax.study.shared.folder import Arrays
from ewif_jax.types import Estimator, Measurement, Numbers, RandomKey, Trace

Observe = Callable[[Trace, Simulation], Mapping[str, Any]]
PARTS = 5
"""how many parts of a batch are timed, so that times have standard errors"""


def over_cores(compute: Callable[..., Any]) -> Callable[..., Any]:
    """`compute` for each entry of the leading axis of its arguments, one after the other on each
    local device; arrays of the host come back. It is compiled once for each length."""
    devices = len(jax.local_devices())

    def on_one(inputs: tuple) -> Any:
        return lax.map(lambda one: compute(*one), inputs)

    program = jax.jit(over_devices(on_one, (True,), devices))

    def call(*inputs: Any) -> Any:
        count = jax.tree.leaves(inputs)[0].shape[0]
        index = equal_part(count, -(-count // devices) * devices, 0)
        found = program(jax.tree.map(lambda x: x[index], inputs))
        return jax.tree.map(lambda x: x[:count], jax.device_get(found))

    return call


def tracker(
    estimator: Estimator, scenario: Scenario, observe: Observe, clock: Clock | None = None
) -> Callable[[Simulation, Any], Arrays]:
    """(simulations (R, ...), keys (R,)) -> what `observe` keeps of each run, and "core_seconds"
    (R,): time on one core without compiling, the same for all runs of one of `PARTS` equal parts.
    """

    def track(simulation: Simulation, key: RandomKey) -> Mapping[str, Any]:
        trace = run(
            estimator,
            None,
            simulation.measurements,
            prior=scenario.prior,
            t0=scenario.t0,
            times=simulation.times,
            clock=clock or scenario.clock,
            key=key,
        )
        return observe(trace, simulation)

    program = over_cores(track)

    def call(simulations: Simulation, keys: RandomKey) -> Arrays:
        runs, cores = keys.shape[0], len(jax.local_devices())
        size = -(-runs // (min(PARTS, runs) * cores)) * cores
        found = []
        for index in equal_parts(runs, size):
            some = jax.tree.map(lambda x, i=index: x[i], (simulations, keys))
            with timed() as timing:
                part = program(*some)
            found.append({**part, "core_seconds": np.full(size, timing.run * cores / size)})
        return {name: np.concatenate([x[name] for x in found])[:runs] for name in found[0]}

    return call


def seconds_per_run(core_seconds: np.ndarray) -> Measured:
    """Mean (R,) with the standard error that the scatter of the parts timed separately gives;
    unknown from one."""
    parts = np.unique(core_seconds)
    error = np.std(parts, ddof=1) / np.sqrt(parts.size) if parts.size > 1 else np.nan
    return Measured(float(core_seconds.mean()), float(error))


def per_run(simulation: Simulation) -> Simulation:
    """A batch of simulations in which every leaf leads with the runs."""
    runs = simulation.measurements.value.shape[0]

    def full(x: Numbers, rank: int) -> Any:
        x = np.asarray(x)
        return x if x.ndim > rank else np.broadcast_to(x, (runs, *x.shape))

    time, value, sensor, mask = simulation.measurements
    stream = Measurement(full(time, 1), full(value, 2), full(sensor, 1), full(mask, 2))
    times = None if simulation.times is None else full(simulation.times, 1)
    return Simulation(stream, full(simulation.truth, 2), times)
