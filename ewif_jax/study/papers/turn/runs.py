"""The runs of the study of the turn: the filters, what is kept of each run, and the bounds."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ewif_jax.analysis.pcrlb import pcrlb_late
from ewif_jax.estimators.bootstrap import bootstrap
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.extended import extended
from ewif_jax.estimators.unscented import unscented
from ewif_jax.monte_carlo import Simulation, simulate_batch
from ewif_jax.oosm.drop_late import drop_late
from ewif_jax.oosm.pf_extended import pf_extended
from ewif_jax.oosm.pf_fixed_point import pf_fixed_point
from ewif_jax.oosm.replay import replay
from ewif_jax.scenarios.turn import Q_TURN, SECONDS, Q, turn, turn_model, turn_state
from ewif_jax.study.shared.folder import Arrays
from ewif_jax.study.shared.one_by_one import over_cores, per_run, tracker
from ewif_jax.types import Estimator, Numbers, RandomKey, Status, Trace

LAG, BUFFER = 5, 12
STD, ORD, EXT, EXACT = "PFstd", "PFord", "PFoosmEXT", "exact replay"
EKS, UKS, PS = "PFoosmEKS", "PFoosmUKS", "PFoosmPS"
EKF, UKF, EWIF = "EKF", "UKF", "EWIF"
TAU = 4.0
"""s; of the EWIF: the best of 0.5, 1, 2, ... 32, 100 s on 200 other runs"""
TIMES = np.arange(SECONDS + 1.0)
PRINTED = {"ut_alpha": 1e-3, "ut_beta": 2.0, "ut_kappa": 0.0}
"""sigma points of the paper"""


class TurnMethod(NamedTuple):
    """An estimator, whether its stream is in order of time, and the share of the runs it is given
    (what is only a reference needs fewer)."""

    estimator: Estimator
    in_order: bool = False
    share: float = 1.0


def turn_methods(particles: int = 10_000) -> dict[str, TurnMethod]:
    """The six filters of the paper, the exact answer of the particle filter, the two filters that
    the paper gave up, and the EWIF with lines through sigma points. The paper's sigma points need
    float64; in float32 those of the cubature rule take their place."""
    model = turn_model()
    in_sequence = bootstrap(model, particles)
    points: dict[str, Any] = PRINTED if _as_printed() else {}

    def smoothing(smoother: Any, **setting: Any) -> TurnMethod:
        return TurnMethod(pf_fixed_point(model, particles, LAG, smoother, **setting))

    return {
        STD: TurnMethod(drop_late(in_sequence)),
        ORD: TurnMethod(in_sequence, in_order=True),
        EXT: TurnMethod(pf_extended(model, particles, LAG)),
        EKS: smoothing("eks"),
        UKS: smoothing("uks", **points),
        PS: smoothing("ps"),
        EXACT: TurnMethod(replay(in_sequence, BUFFER, width=2), share=0.1),
        EKF: TurnMethod(extended(model)),
        UKF: TurnMethod(unscented(model, **points)),
        EWIF: TurnMethod(ewif(model, TAU, linearisation="sigma-points")),
    }


def sigma_points_note() -> str:
    """Which sigma points `turn_methods` uses."""
    if _as_printed():
        return "PFoosmUKS and UKF: sigma points as printed, alpha = 1e-3, beta = 2, kappa = 0."
    return "PFoosmUKS and UKF: cubature points; float32 cannot carry the printed alpha = 1e-3."


def turn_worlds(key: RandomKey, runs: int) -> dict[bool, Simulation]:
    """The same runs as they arrive (False) and in order of time (True)."""
    keys = jax.random.split(key, runs)
    return {
        in_order: per_run(simulate_batch(turn(in_order=in_order), keys))
        for in_order in (False, True)
    }


def followed_turns(method: TurnMethod, batch: Simulation, keys: RandomKey) -> Arrays:
    """Of every run (R,) of a batch in the order that the method asks for: the track (R, 31, 2),
    squared errors of position and velocity (R, 31) at each second, counts of what became of the
    measurements, and core_seconds."""
    return _turn_tracker(method.estimator, method.in_order)(batch, keys)


def turn_bounds(batch: Simulation) -> Arrays:
    """Variances (T,) of position and velocity without the third sensor and, "late_", with what has
    arrived of it (an average over runs); and "parametric_", for a target that is known to turn
    steadily. The others are bounds for targets that the noise of the model drives, on average: on
    this one path a filter may be better."""
    scenario = turn()
    assert scenario.prior is not None
    model = turn_model(q=lambda p: p[0], q_turn=lambda p: p[1])
    setting = {
        "start": turn_state(0.0),
        "prior_cov": scenario.prior.cov,
        "t0": 0.0,
        "times": np.repeat(TIMES, 2),
    }

    def errors_of(stream: Numbers, noise: Numbers) -> dict[str, Any]:
        bound = pcrlb_late(model, noise, stream, turn_state(stream.time), **setting)[1::2]
        variances = jnp.diagonal(bound, axis1=1, axis2=2)
        return {"position": variances[:, :2].sum(1), "velocity": variances[:, 2:4].sum(1)}

    stream = jax.tree.map(lambda x: np.concatenate([x, x[:2]]), batch.measurements)
    runs = stream.time.shape[0] - 2
    alone = (stream.sensor == 0) | (np.arange(runs + 2) < runs)[:, None]
    stream = stream._replace(mask=stream.mask & alone[..., None])
    noise = np.asarray([(Q, Q_TURN)] * (runs + 1) + [(0.0, 0.0)])
    found = over_cores(errors_of)(stream, noise)
    parts = {"late_": slice(runs), "": runs, "parametric_": runs + 1}
    return {
        begin + kind: np.mean(np.atleast_2d(x[part]), 0)
        for begin, part in parts.items()
        for kind, x in found.items()
    }


def _as_printed() -> bool:
    return jnp.zeros(()).dtype == jnp.float64


@cache
def _turn_tracker(estimator: Estimator, in_order: bool) -> Callable[..., Arrays]:
    """Compiled once for all methods that are the same filter."""
    return tracker(estimator, turn(in_order=in_order), _turn_observer(0 if in_order else 1))


def _turn_observer(marker: int) -> Callable[[Trace, Simulation], dict[str, Any]]:
    """What to keep of a run: at each second, after the arrival of sensor `marker`."""

    def observe(trace: Trace, simulation: Simulation) -> dict[str, Any]:
        at = jnp.flatnonzero(simulation.measurements.sensor == marker, size=TIMES.size)
        mean, status = trace.mean[at], trace.info.status
        truth = turn_state(jnp.asarray(TIMES, mean.dtype))
        off = jnp.square(mean - truth)

        def count(kind: Status) -> Any:
            return jnp.sum(status == kind)

        return {
            "track": mean[:, :2],
            "position": off[:, 0] + off[:, 1],
            "velocity": off[:, 2] + off[:, 3],
            "late_used": count(Status.LATE_USED),
            "too_late": count(Status.TOO_LATE),
            "rejected": count(Status.REJECTED),
        }

    return observe
