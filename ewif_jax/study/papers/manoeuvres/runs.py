"""The filters of the study of manoeuvres, the settings each may have, and an example."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.estimator import run as run_filter
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.extended import extended
from ewif_jax.estimators.imm import imm, imm_probabilities
from ewif_jax.estimators.kalman import kalman
from ewif_jax.live import arrivals, step
from ewif_jax.models import Model, constant_velocity, position_sensor
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.oosm.drop_late import drop_late
from ewif_jax.oosm.replay import replay
from ewif_jax.scenarios.arrowhead import arrowhead, arrowhead_path
from ewif_jax.scenarios.turn import turn, turn_model
from ewif_jax.study.shared.folder import Arrays
from ewif_jax.study.shared.late import sweep
from ewif_jax.types import Estimator, Gaussian, Measurement, Numbers, Parameter, Params, RandomKey

KALMAN, EWIF, IMM = "Kalman", "EWIF", "IMM"
VARIANCE = 2000.0
QUIET = 1e-3
"""what the quiet mode of the turn has of the noise of the other"""


class Manoeuvre(NamedTuple):
    """A scenario, the state that is known at its start, and how many measurements a replay keeps;
    size: of a measurement; filters: by name, with the settings it may have, (V,) by parameter,
    before anything is done about late data."""

    scenario: Scenario
    prior: Gaussian
    past: int
    size: int
    filters: dict[str, tuple[Estimator, dict[str, np.ndarray]]]


def settings(**choices: Any) -> dict[str, np.ndarray]:
    """Every combination of the values of each parameter."""
    every = np.meshgrid(*(np.asarray(x, float) for x in choices.values()), indexing="ij")
    return {name: x.ravel() for name, x in zip(choices, every, strict=True)}


def changing(params: Params, t0: Numbers, t1: Numbers) -> Array:
    """The probabilities (2, 2) of two modes that change into each other `rate` times a second."""
    stays = (1 + jnp.exp(-2 * params["rate"] * (t1 - t0))) / 2
    return jnp.stack([jnp.stack([stays, 1 - stays]), jnp.stack([1 - stays, stays])])


def arrowhead_manoeuvre(steps: int) -> Manoeuvre:
    """The arrowhead with a velocity in the state: constant but for noise."""
    scenario = arrowhead(r=VARIANCE, steps=steps)
    start: Any = np.concatenate([np.asarray(arrowhead_path(0.0)), np.zeros(2)])
    spread: Any = np.diag([1.0, 1.0, 25.0, 25.0])
    prior = Gaussian(start, spread)

    def moving(q: Parameter) -> Model:
        return constant_velocity(sensors=position_sensor(VARIANCE, dims=2), q=q, dims=2)

    modes = [kalman(moving(lambda p, name=name: p[name])) for name in ("quiet", "busy")]
    filters = {
        EWIF: (ewif(moving(0.0), lambda p: p["tau"]), settings(tau=np.geomspace(2, 64, 16))),
        KALMAN: (kalman(moving(lambda p: p["q"])), settings(q=np.geomspace(1e-3, 10, 16))),
        IMM: (
            imm(modes, changing),
            settings(
                quiet=np.geomspace(1e-3, 0.3, 4), busy=np.geomspace(0.3, 10, 4), rate=[0.02, 0.1]
            ),
        ),
    }
    return Manoeuvre(scenario, prior, 20, 2, filters)


def turn_manoeuvre() -> Manoeuvre:
    """The fast turn seen by bearings, in its own state."""
    scenario = turn()
    assert scenario.prior is not None

    def turning(q: Parameter, q_turn: Parameter) -> Estimator:
        return extended(turn_model(q, q_turn))

    quiet = turning(lambda p: QUIET * p["q"], lambda p: QUIET * p["q_turn"])
    busy = turning(lambda p: p["q"], lambda p: p["q_turn"])
    noise = {"q": np.geomspace(10, 1000, 5), "q_turn": np.geomspace(1e-5, 1e-2, 4)}
    own = ewif(turn_model(), lambda p: p["tau"], linearisation="sigma-points")
    filters = {
        EWIF: (own, settings(tau=np.geomspace(2, 32, 16))),
        KALMAN: (busy, settings(**noise)),
        IMM: (imm([quiet, busy], changing), settings(**noise, rate=[0.05, 0.2])),
    }
    return Manoeuvre(scenario, scenario.prior, 16, 2, filters)


def with_late_data(manoeuvre: Manoeuvre, name: str, late: bool) -> Estimator:
    """A filter that uses late measurements or drops them. The EWIF takes them as they are, the
    others by an exact replay."""
    estimator, _ = manoeuvre.filters[name]
    if not late:
        return drop_late(estimator)
    if name == EWIF:
        return estimator
    return replay(estimator, manoeuvre.past, width=manoeuvre.size)


def chosen_settings(
    manoeuvre: Manoeuvre, late: bool, batch: Simulation, progress: Callable[[int, int], None]
) -> Arrays:
    """By filter and parameter, "EWIF tau", the setting with the smallest error on a batch."""
    found = {}
    for name, (_, choices) in manoeuvre.filters.items():
        method = with_late_data(manoeuvre, name, late)
        setting = {"prior": manoeuvre.prior, "t0": 0.0}
        squared = sweep(method, choices, batch, progress=progress, **setting)["squared_error"]
        best = int(np.argmin(np.nan_to_num(squared.mean(1), nan=np.inf)))
        found |= {f"{name} {key}": x[best] for key, x in choices.items()}
    return found


def params_of(chosen: Arrays, name: str) -> dict[str, float]:
    """The parameters of one filter in what `chosen_settings` gives."""
    begin = f"{name} "
    return {k.removeprefix(begin): float(x) for k, x in chosen.items() if k.startswith(begin)}


def example_modes(manoeuvre: Manoeuvre, chosen: Arrays, key: RandomKey) -> Arrays:
    """One run of the arrowhead: times, what was seen, the truth, the track of every filter, and the
    probability of the busy mode."""
    run = manoeuvre.scenario.simulate(key)
    tracks = {}
    for name in manoeuvre.filters:
        late, params = with_late_data(manoeuvre, name, True), params_of(chosen, name)
        trace = run_filter(late, params, run.measurements, prior=manoeuvre.prior, t0=0.0)
        tracks[name] = np.asarray(trace.mean[:, :2])
        if name == IMM:
            tracks["busy"] = _busy(late, params, run.measurements, manoeuvre.prior)
    time = np.maximum.accumulate(np.asarray(run.measurements.time))
    truth, seen = np.asarray(run.truth), np.asarray(run.measurements.value)
    return {"time": time, "truth": truth, "seen": seen, **tracks}


def _busy(late: Estimator, params: Params, stream: Measurement, prior: Gaussian) -> np.ndarray:
    """The probability (T,) of the busy mode after each arrival."""
    dtype = jnp.asarray(stream.value).dtype
    given = Gaussian(jnp.asarray(prior.mean, dtype), jnp.asarray(prior.cov, dtype))
    state, found = late.init(params, given, jnp.zeros((), dtype)), []
    for arrival in arrivals(stream):
        state, _ = step(late, params, state, arrival)
        found.append(float(imm_probabilities(state.current)[1]))
    return np.asarray(found)


def path_acceleration(time: np.ndarray) -> np.ndarray:
    """How fast the velocity of the arrowhead changes, m/s^2, at `time` (T,)."""
    twice = jax.jacfwd(jax.jacfwd(arrowhead_path))
    return np.linalg.norm(np.asarray(jax.vmap(twice)(jnp.asarray(time))), axis=-1)
