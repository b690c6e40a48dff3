"""The runs of the study of two bearing sensors: every filter on every delay at once."""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ewif_jax.analysis.pcrlb import pcrlb_equivalent, pcrlb_late
from ewif_jax.estimator import Clock
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.extended import extended
from ewif_jax.monte_carlo import Scenario, Simulation, simulate_batch
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.drop_late import drop_late
from ewif_jax.oosm.enkf1 import enkf1
from ewif_jax.oosm.enkf2 import enkf2
from ewif_jax.oosm.pf_retrodict import pf_retrodict
from ewif_jax.oosm.replay import replay
from ewif_jax.oosm.rts_reference import rts_reference
from ewif_jax.scenarios.two_bearings import (
    START,
    two_bearings,
    two_bearings_model,
    two_bearings_path,
)
from ewif_jax.study.shared.folder import Arrays
from ewif_jax.study.shared.one_by_one import over_cores, per_run, tracker
from ewif_jax.types import Estimator, Numbers, RandomKey, Trace

DELAYS = (0.0, 5.0, 10.0)
LAG, MEMBERS = 12, 250
EKF, RTS, ENKF1, ENKF2, SHARED = "EKF (Al1)", "RTS-based", "EnKF1", "EnKF2", "EnKF2, shared noise"
EWIF, TAU = "EWIF", 3.5
"""s: the best of 1.5, 2, ... 5 s over the three delays, on 100 other runs"""
PF, HALF, EXACT, DROP = "PF", "PF, half as many", "EKF, exact replay", "EKF, late dropped"
ONE, OTHER = "Fil-1 (sensor 1)", "Fil-2 (sensor 2)"


class BearingsMethod(NamedTuple):
    """An estimator, the clock it runs by, and the only sensor it hears (None: both)."""

    estimator: Estimator
    clock: Clock = "arrival"
    sensor: int | None = None


class World(NamedTuple):
    """D delays of the same R targets in one batch of D R runs, delay by delay: their simulations,
    padded to one length with masked rows; the keys of the simulations (D R,); when what arrives,
    (D, T), NaN where there is only padding."""

    batch: Simulation
    keys: Any
    times: np.ndarray


def bearings_methods(particles: int = 10_000) -> dict[str, BearingsMethod]:
    """The seven of the paper, the particle filter with half the particles, the baselines, and the
    EWIF with lines through sigma points."""
    model = two_bearings_model()
    ekf = al1(model, LAG)
    return {
        ONE: BearingsMethod(ekf, sensor=0),
        OTHER: BearingsMethod(ekf, sensor=1),
        EKF: BearingsMethod(ekf),
        RTS: BearingsMethod(rts_reference(model, LAG)),
        ENKF1: BearingsMethod(enkf1(model, MEMBERS, LAG)),
        ENKF2: BearingsMethod(enkf2(model, MEMBERS, LAG)),
        SHARED: BearingsMethod(enkf2(model, MEMBERS, LAG, "shared")),
        PF: BearingsMethod(pf_retrodict(model, particles, collapse=None)),
        HALF: BearingsMethod(pf_retrodict(model, particles // 2, collapse=None)),
        DROP: BearingsMethod(drop_late(extended(model)), "validity"),
        EXACT: BearingsMethod(replay(extended(model), LAG, width=1)),
        EWIF: BearingsMethod(ewif(model, TAU, linearisation="sigma-points")),
    }


def bearings_world(key: RandomKey, runs: int) -> World:
    """The same targets under every delay."""
    keys = jax.random.split(key, runs)
    batches = [per_run(simulate_batch(two_bearings(delay), keys)) for delay in DELAYS]
    longest = max(batch.truth.shape[1] for batch in batches)
    times = [
        np.append(np.asarray(x.times)[0], np.full(longest - x.truth.shape[1], np.nan))
        for x in batches
    ]
    together = jax.tree.map(
        lambda *x: np.concatenate(x), *(_padded_batch(batch, longest) for batch in batches)
    )
    return World(together, jnp.concatenate([keys] * len(DELAYS)), np.stack(times))


def followed_bearings(method: BearingsMethod, world: World, key: RandomKey) -> Arrays:
    """Errors and reported variances of x and y (D, R, T, 2), NaN in the padding, and core_seconds
    (D, R) of every run."""
    batch = world.batch
    if method.sensor is not None:
        stream = batch.measurements
        heard = (stream.sensor == method.sensor)[..., None]
        batch = batch._replace(measurements=stream._replace(mask=stream.mask & heard))
    follow = _bearings_tracker(method.estimator, method.clock)
    found = follow(batch, jax.random.split(key, world.keys.shape[0]))
    return {name: x.reshape(len(DELAYS), -1, *x.shape[1:]) for name, x in found.items()}


def bearings_bounds(world: World) -> Arrays:
    """Variances of x and y (D, R, T, 2) that no filter can beat ("right"), and those that the paper
    prints ("published")."""
    prior, model = _bearings_scenario().prior, two_bearings_model()
    assert prior is not None
    setting = {"start": np.asarray(START), "prior_cov": prior.cov, "t0": 0.0}

    def along(key: RandomKey, simulation: Simulation) -> dict[str, Any]:
        stream, truth, times = simulation
        seen, now = (two_bearings_path(key, t) for t in (stream.time, times))
        right = pcrlb_late(model, None, stream, seen, **setting, times=times)
        printed = pcrlb_equivalent(model, None, stream, now, **setting, times=times)
        pair = (("right", right), ("published", printed))
        return {name: _position_variances(x) + 0 * truth for name, x in pair}

    found = over_cores(along)(world.keys, world.batch)
    return {name: x.reshape(len(DELAYS), -1, *x.shape[1:]) for name, x in found.items()}


@cache
def _bearings_tracker(estimator: Estimator, clock: Clock) -> Any:
    """Compiled once for all methods that are the same filter."""
    return tracker(estimator, _bearings_scenario(), _observe_track, clock)


def _bearings_scenario() -> Scenario:
    """Prior and clock, which do not depend on the delay."""
    return two_bearings()


def _observe_track(trace: Trace, simulation: Simulation) -> dict[str, Any]:
    truth = simulation.truth
    return {
        "error": trace.mean[:, :2] - truth,
        "variance": _position_variances(trace.cov) + 0 * truth,
    }


def _position_variances(cov: Numbers) -> Any:
    """Of x and y (T, 2)."""
    return jnp.stack([cov[:, 0, 0], cov[:, 1, 1]], -1)


def _padded_batch(batch: Simulation, length: int) -> Simulation:
    """More rows that say nothing, at the time of the last one; truth is NaN there."""
    more = length - batch.truth.shape[1]

    def last(x: Numbers) -> np.ndarray:
        return np.concatenate([x, np.repeat(x[:, -1:], more, axis=1)], axis=1)

    stream = jax.tree.map(last, batch.measurements)
    there = np.arange(length) < batch.truth.shape[1]
    stream = stream._replace(mask=stream.mask & there[:, None])
    truth = np.where(there[:, None], last(batch.truth), np.nan)
    return Simulation(stream, jnp.asarray(truth), jnp.asarray(last(batch.times)))
