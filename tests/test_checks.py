"""What is refused before tracing, in words: the argument, what was expected, what came."""

import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import ewif_jax as ej
from ewif_jax import Gaussian, Measurement, batch, every_run
from ewif_jax.analysis.anderson import System
from ewif_jax.analysis.anderson_continuous import ContinuousSystem
from ewif_jax.continuous.kalman_bucy import Signal
from ewif_jax.models import (
    bearing_sensor,
    constant_velocity,
    position_sensor,
    random_walk,
)
from ewif_jax.scenarios.delays import by_sensor, losses

WORLD = constant_velocity(sensors=[position_sensor(0.5), position_sensor(1.5)], q=0.2)
KALMAN = ej.kalman(WORLD)
EWIF = ej.ewif(WORLD, 1.0)
PRIOR = Gaussian(np.array([0.3, -1.0]), np.diag([2.0, 0.5]))
STREAM = Measurement(
    np.array([0.1, 0.2, 0.3]), np.ones((3, 1)), np.array([0, 1, 0]), np.ones((3, 1), bool)
)


def run(estimator=KALMAN, stream=STREAM, prior=PRIOR, t0=0.0, params=None, **options):
    return ej.run(estimator, params, stream, prior=prior, t0=t0, **options)


def swap(**fields):
    return STREAM._replace(**fields)


SQUARE = np.eye(2)
NOT_SYMMETRIC = np.array([[1.0, 0.5], [0.0, 1.0]])
NOT_PSD = np.array([[1.0, 2.0], [2.0, 1.0]])
NAN = np.full((2, 2), np.nan)
ROW = np.array([[1.0, 0.0]])
SYSTEM = System(SQUARE, ROW, SQUARE, np.eye(1))
FLOW = ContinuousSystem(-SQUARE, ROW.T, ROW, np.eye(1), np.eye(1))
EPOCH = 1.7e9 + np.array([0.0, 0.01, 0.02])

REFUSED = {
    # streams
    "not a Measurement": (
        lambda: run(stream=tuple(STREAM)),
        "measurements: expected a Measurement, got tuple",
    ),
    "empty": (
        lambda: run(stream=jax.tree.map(lambda x: x[:0], STREAM)),
        "measurements: expected at least one measurement, got an empty stream",
    ),
    "values without components": (
        lambda: run(stream=swap(value=np.ones(3))),
        r"measurements.value: expected shape (T, m), got shape (3,)",
    ),
    "ragged times": (
        lambda: run(stream=swap(time=np.zeros(2))),
        "measurements.time: expected 3 arrivals, got 2",
    ),
    "ragged sensors": (
        lambda: run(stream=swap(sensor=np.zeros(4, int))),
        "measurements.sensor: expected 3 arrivals, got 4",
    ),
    "times of rank 2": (
        lambda: run(stream=swap(time=np.zeros((3, 1)))),
        "measurements.time: expected shape (T,), got shape (3, 1)",
    ),
    "mask of another width": (
        lambda: run(stream=swap(mask=np.ones((3, 2), bool))),
        "measurements.mask: expected shape (T, 1), got shape (3, 2)",
    ),
    "mask of numbers": (
        lambda: run(stream=swap(mask=np.ones((3, 1)))),
        "measurements.mask: expected booleans, got float64",
    ),
    "mask as a list of numbers": (
        lambda: run(stream=swap(mask=[[1], [1], [0]])),
        "measurements.mask: expected booleans, got int64",
    ),
    "sensors of floats": (
        lambda: run(stream=swap(sensor=np.zeros(3))),
        "measurements.sensor: expected integers, got float64",
    ),
    "a negative sensor": (
        lambda: run(stream=swap(sensor=np.array([0, -1, 0]))),
        "measurements.sensor: expected indices >= 0, got -1",
    ),
    "NaN time": (
        lambda: run(stream=swap(time=np.array([0.0, np.nan, 1.0]))),
        "measurements.time: expected finite numbers, got nan at index 1",
    ),
    "NaN under a mask that is True": (
        lambda: run(stream=swap(value=np.array([[1.0], [1.0], [np.nan]]))),
        "measurements.value: expected finite numbers where mask is True "
        "(mask out what is missing), got nan at index (2, 0)",
    ),
    "components the model does not have": (
        lambda: run(stream=swap(value=np.ones((3, 2)), mask=np.ones((3, 2), bool))),
        "measurement.value: expected shape (1,), got shape (2,)",
    ),
    "epoch seconds in float32": (
        lambda: run(stream=swap(time=EPOCH, value=STREAM.value.astype(np.float32))),
        "measurements.time: expected times that float32 can tell apart",
    ),
    "epoch seconds in a float32 `stream`": (
        lambda: ej.stream(EPOCH, np.ones(3, np.float32)),
        "measurements.time: expected times that float32 can tell apart",
    ),
    "stream of rank 3": (
        lambda: ej.stream(np.zeros(3), np.zeros((3, 1, 1))),
        "value: expected shape (T, m), got shape (3, 1, 1)",
    ),
    "stream with other times": (
        lambda: ej.stream(np.zeros(4), np.zeros(3)),
        "time: expected shape (3,), got shape (4,)",
    ),
    # sensors
    "a sensor beyond the bank": (
        lambda: run(stream=swap(sensor=np.array([0, 2, 1]))),
        "measurement.sensor: expected an index below 2 (the model has 2 sensors), got 2",
    ),
    "a sensor beyond the only one": (
        lambda: run(ej.kalman(random_walk(sensors=position_sensor(1.0))), prior=scalar()),
        "measurement.sensor: expected an index below 1 (the model has 1 sensor), got 1",
    ),
    "a sensor beyond a table in a function": (
        lambda: run(table_in_a_function(), stream=swap(sensor=np.array([0, 2, 1]))),
        "measurement.sensor: expected an index inside the tables that H and R",
    ),
    "a sensor beyond a table in params": (
        lambda: run(
            table_in_params(), stream=swap(sensor=np.array([0, 5, 1])), params=np.ones((2, 1, 2))
        ),
        "measurement.sensor: expected an index inside the tables",
    ),
    "a sensor beyond the bank, streaming": (
        lambda: ej.step(
            KALMAN,
            None,
            KALMAN.init(None, PRIOR, 0.0),
            Measurement(1.0, np.ones(1), 3, np.ones(1, bool)),
        ),
        "measurement.sensor: expected an index below 2",
    ),
    "a negative sensor, streaming": (
        lambda: ej.step(
            EWIF,
            None,
            EWIF.init(None, PRIOR, 0.0),
            Measurement(1.0, np.ones(1), -1, np.ones(1, bool)),
        ),
        "measurement.sensor: expected an index >= 0, got -1",
    ),
    # priors
    "no prior, covariance form": (
        lambda: run(prior=None),
        "prior: expected a Gaussian: kalman carries a covariance",
    ),
    "a tuple for a prior": (
        lambda: run(prior=(PRIOR.mean, PRIOR.cov)),
        "prior: expected a Gaussian(mean, cov) or None, got tuple",
    ),
    "a prior mean of rank 2": (
        lambda: run(prior=Gaussian(np.zeros((2, 1)), SQUARE)),
        "prior.mean: expected shape (n,), got shape (2, 1)",
    ),
    "a prior covariance of variances": (
        lambda: run(prior=Gaussian(np.zeros(2), np.ones(2))),
        "prior.cov: expected shape (2, 2), got shape (2,)",
    ),
    "a prior that is not PSD": (
        lambda: run(prior=Gaussian(np.zeros(2), NOT_PSD)),
        "prior.cov: expected a positive semidefinite matrix, got smallest eigenvalue -1",
    ),
    "a prior that is not symmetric": (
        lambda: run(prior=Gaussian(np.zeros(2), NOT_SYMMETRIC)),
        "prior.cov: expected a symmetric matrix, got asymmetry 0.5",
    ),
    "a NaN prior": (
        lambda: run(prior=Gaussian(np.array([0.0, np.nan]), SQUARE)),
        "prior.mean: expected finite numbers, got nan at index 1",
    ),
    "a singular prior, information form": (
        lambda: run(EWIF, prior=Gaussian(np.zeros(2), np.diag([1.0, 0.0]))),
        "prior.cov: expected a positive definite matrix, got smallest eigenvalue 0",
    ),
    "a prior of another size": (
        lambda: run(prior=Gaussian(np.zeros(3), np.eye(3))),
        "F: expected shape (3, 3), got shape (2, 2)",
    ),
    "a prior of another size, information form": (
        lambda: run(EWIF, prior=Gaussian(np.zeros(3), np.eye(3))),
        "F: expected shape (3, 3), got shape (2, 2)",
    ),
    # times
    "a vector for t0": (lambda: run(t0=np.zeros(2)), "t0: expected shape (), got shape (2,)"),
    "NaN for t0": (lambda: run(t0=np.nan), "t0: expected finite numbers, got nan"),
    "too few report times": (
        lambda: run(times=np.zeros(2)),
        "times: expected shape (3,), got shape (2,)",
    ),
    "report times that decrease": (
        lambda: run(times=np.array([1.0, 3.0, 2.0])),
        "times: expected report times that do not decrease, got 2.0 after 3.0",
    ),
    "NaN report times": (
        lambda: run(times=np.array([1.0, np.nan, 2.0])),
        "times: expected finite numbers, got nan at index 1",
    ),
    "an unknown clock": (
        lambda: run(clock="wall"),
        "clock: expected 'validity' or 'arrival', got wall",
    ),
    "an arrival clock without times": (
        lambda: run(clock="arrival"),
        "times: expected arrival times, since clock='arrival', got None",
    ),
    # estimators
    "tau = 0": (lambda: ej.ewif(WORLD, 0.0), "tau: expected a positive number, got 0.0"),
    "tau < 0 in params": (
        lambda: run(ej.ewif(WORLD, lambda p: p), params=-1.0),
        "tau: expected a positive number, got -1.0",
    ),
    "a negative tau among the parameters, as an array": (
        lambda: run(ej.ewif(WORLD, lambda p: p["tau"]), params={"tau": np.array(-1.0)}),
        "tau: expected a positive number, got -1.0",
    ),
    "a negative tau of one run among many": (
        lambda: ej.run_batch(
            ej.ewif(WORLD, lambda p: p["tau"]),
            {"tau": np.array([1.0, -2.0])},
            swap(value=np.ones((2, 3, 1))),
            prior=PRIOR,
            t0=0.0,
            params_per_run=True,
        ),
        "tau: expected a positive number, got -2.0",
    ),
    "NaN tau": (lambda: ej.ewif(WORLD, np.nan), "tau: expected a positive number, got nan"),
    "tau in words": (lambda: ej.ewif(WORLD, "1"), "tau: expected a positive number, got '1'"),
    "neither tau nor weight": (lambda: ej.ewif(WORLD), "tau: expected one of `tau` and `weight`"),
    "tau and weight": (
        lambda: ej.ewif(WORLD, 1.0, weight=lambda p, a, b: 1.0),
        "tau: expected one of",
    ),
    "fading < 1": (lambda: ej.fading(WORLD, 0.9), "fading: expected a number >= 1.0, got 0.9"),
    "fading < 1 in params": (
        lambda: run(ej.fading(WORLD, lambda p: p), params=0.5),
        "fading: expected a number >= 1.0, got 0.5",
    ),
    "neither fading nor inflation": (lambda: ej.fading(WORLD), "fading: expected one of"),
    "no window": (
        lambda: ej.limited_memory(WORLD, 0.0, 4),
        "window: expected a positive number, got 0.0",
    ),
    "no capacity": (
        lambda: ej.limited_memory(WORLD, 1.0, 0),
        "capacity: expected a whole number >= 1, got 0",
    ),
    "half a capacity": (
        lambda: ej.limited_memory(WORLD, 1.0, 2.5),
        "capacity: expected a whole number >= 1, got 2.5",
    ),
    **{
        f"{name} of a nonlinear model": (
            lambda build=build: build(constant_velocity(sensors=bearing_sensor(0.1), dims=2)),
            "model: expected a linear model",
        )
        for name, build in {
            "kalman": ej.kalman,
            "information": ej.information,
            "square_root": ej.square_root,
            "fading": lambda model: ej.fading(model, 1.0),
            "ewif": lambda model: ej.ewif(model, 1.0),
            "limited_memory": lambda model: ej.limited_memory(model, 1.0, 3),
        }.items()
    },
    "extended of no model": (lambda: ej.extended(SQUARE), "model: expected a Model, got ndarray"),
    # models
    "F not square": (
        lambda: ej.linear_model(np.ones((2, 3)), SQUARE, SQUARE),
        "F: expected a square matrix, got (2, 3)",
    ),
    "F a vector": (
        lambda: ej.linear_model(np.ones(2), SQUARE, SQUARE),
        "F: expected shape (n, n), got shape (2,)",
    ),
    "F not finite": (lambda: ej.linear_model(NAN, SQUARE, SQUARE), "F: expected finite numbers"),
    "Q not PSD": (
        lambda: ej.linear_model(SQUARE, SQUARE, SQUARE, NOT_PSD),
        "Q: expected a positive semidefinite matrix, got smallest eigenvalue -1",
    ),
    "Q of another size": (
        lambda: ej.linear_model(SQUARE, SQUARE, SQUARE, np.eye(3)),
        "Q: expected shape (2, 2), got shape (3, 3)",
    ),
    "b of another size": (
        lambda: ej.linear_model(SQUARE, SQUARE, SQUARE, b=np.ones(3)),
        "b: expected shape (2,), got shape (3,)",
    ),
    "R not PSD": (
        lambda: ej.linear_model(SQUARE, SQUARE, NOT_PSD),
        "R: expected a positive semidefinite matrix",
    ),
    "R[1] not PSD": (
        lambda: ej.linear_model(SQUARE, SQUARE, np.stack([SQUARE, NOT_PSD])),
        "R[1]: expected a positive semidefinite matrix",
    ),
    "H a vector": (
        lambda: ej.linear_model(SQUARE, np.ones(2), SQUARE),
        "H: expected a function, a matrix or a table (S, ., .), got (2,)",
    ),
    "H not finite": (lambda: ej.linear_model(SQUARE, NAN, SQUARE), "H: expected finite numbers"),
    "H and R of other numbers of sensors": (
        lambda: ej.linear_model(SQUARE, np.ones((2, 1, 2)), np.ones((3, 1, 1))),
        "R: expected as many sensors as H has (2), got 3 sensors",
    ),
    "H of another width than the state": (
        lambda: run(ej.kalman(ej.linear_model(SQUARE, np.ones((1, 3)), np.eye(1))), stream=one()),
        "H: expected shape (m, 2), got shape (1, 3)",
    ),
    "R of another size than the value": (
        lambda: run(ej.kalman(ej.linear_model(SQUARE, np.ones((1, 2)), SQUARE)), stream=one()),
        "R: expected shape (1, 1), got shape (2, 2)",
    ),
    "q < 0": (
        lambda: random_walk(sensors=position_sensor(1.0), q=-1.0),
        "q: expected a number >= 0.0, got -1.0",
    ),
    "no dimension": (
        lambda: random_walk(sensors=position_sensor(1.0), dims=0),
        "dims: expected a whole number >= 1, got 0",
    ),
    "unknown noise": (
        lambda: constant_velocity(sensors=position_sensor(1.0), noise="pink"),
        "noise: expected 'white' or 'discrete', got 'pink'",
    ),
    "no sensor": (lambda: random_walk(sensors=()), "sensors: expected at least one sensor"),
    "something else among the sensors": (
        lambda: constant_velocity(sensors=[position_sensor(1.0), 2.0], dims=2),
        "sensors[1]: expected a Sensor, got a float",
    ),
    "r < 0": (lambda: position_sensor(-1.0), "r: expected a number >= 0.0, got -1.0"),
    "r a vector": (lambda: position_sensor(np.ones(2)), "r: expected shape (1,), got shape (2,)"),
    "a bearing sensor in space": (
        lambda: bearing_sensor(1.0, (0.0, 0.0, 0.0)),
        "position: expected shape (2,), got shape (3,)",
    ),
    # merit of a late measurement
    "F not square, for a gain": (
        lambda: ej.steady_state_gain(np.ones((2, 3)), ROW, SQUARE, 1.0),
        "F: expected shape (2, 2), got shape (2, 3)",
    ),
    "R < 0, for a gain": (
        lambda: ej.delayed_gain(1.0, 1.0, 1.0, -1.0, 2),
        "R: expected a positive semidefinite matrix, got smallest eigenvalue -1",
    ),
    "NaN in F, for a gain": (
        lambda: ej.steady_state_gain(np.nan, 1.0, 1.0, 1.0),
        "F: expected finite numbers, got nan",
    ),
    "a negative delay": (
        lambda: ej.delayed_gain(1.0, 1.0, 1.0, 1.0, -0.5),
        "steps: expected a number >= 0, got -0.5",
    ),
    "a negative interval, for a cut-off": (
        lambda: ej.cutoff_delay(1.0, 1.0, 1.0, 1.0, interval=-1.0),
        "interval: expected a positive number, got -1.0",
    ),
    "a ratio of 1": (
        lambda: ej.random_walk_cutoff(1.0, ratio=1.0),
        "ratio: expected a number between 0 and 1, got 1.0",
    ),
    "a negative index": (
        lambda: ej.analysis.alpha_beta_eigenvalues(-1.0),
        "index: expected a number >= 0.0, got -1.0",
    ),
    "a first covariance that is not PSD": (
        lambda: ej.gain_history(SQUARE[None], ROW, SQUARE[None], np.eye(1), NOT_PSD, 2),
        "first_cov: expected a positive semidefinite matrix, got smallest eigenvalue -1",
    ),
    "one noise that is not PSD, for a gain": (
        lambda: ej.gain_history(SQUARE[None], ROW, NOT_PSD[None], np.eye(1), SQUARE, 2),
        "Q[0]: expected a positive semidefinite matrix, got smallest eigenvalue -1",
    ),
    # Anderson, discrete
    "R < 0, weighted": (
        lambda: weighted(R=-np.eye(1)),
        "system.R: expected a positive semidefinite matrix, got smallest eigenvalue -1",
    ),
    "R[1] < 0, weighted": (
        lambda: weighted(R=np.array([[[1.0]], [[-2.0]], [[1.0]]])),
        "system.R[1]: expected a positive semidefinite matrix, got smallest eigenvalue -2",
    ),
    "cov0 not PSD, weighted": (
        lambda: ej.analysis.weighted_covariances(SYSTEM, NOT_PSD, fading=1.1, steps=3),
        "cov0: expected a positive semidefinite matrix, got smallest eigenvalue -1",
    ),
    "H of another width, weighted": (
        lambda: weighted(H=np.ones((1, 3))),
        "system.H: expected shape (1, 2), got shape (1, 3)",
    ),
    "too few matrices, weighted": (
        lambda: weighted(F=np.stack([SQUARE, SQUARE])),
        "system.F: expected shape (3, 2, 2), got shape (2, 2, 2)",
    ),
    "no steps, weighted": (
        lambda: ej.analysis.weighted_covariances(SYSTEM, SQUARE, fading=1.1, steps=0),
        "steps: expected a whole number >= 1, got 0",
    ),
    "fading of another length": (
        lambda: ej.analysis.weighted_covariances(SYSTEM, SQUARE, fading=np.ones(2), steps=3),
        "fading: expected shape (3,), got shape (2,)",
    ),
    "cov0 not PSD, bounds": (
        lambda: ej.analysis.error_bounds(SYSTEM, NOT_PSD, fading=1.1, steps=3),
        "cov0: expected a positive semidefinite matrix",
    ),
    "a gain of another size": (
        lambda: ej.actual_error(np.ones((3, 3, 1)), SYSTEM, SQUARE),
        "cov0: expected shape (3, 3), got shape (2, 2)",
    ),
    "a design of another size": (
        lambda: ej.actual_error(
            np.ones((3, 2, 1)), SYSTEM, SQUARE, design=SYSTEM._replace(H=np.ones((2, 2)))
        ),
        "design.H: expected shape (1, 2), got shape (2, 2)",
    ),
    "a steady state of a sequence": (
        lambda: ej.steady_state(SYSTEM._replace(F=SQUARE[None])),
        "system.F: expected shape (1, 1), got shape (1, 2, 2)",
    ),
    "R = 0, steady": (
        lambda: ej.steady_state(SYSTEM._replace(R=np.zeros((1, 1)))),
        "system.R: expected a positive definite matrix, got smallest eigenvalue 0",
    ),
    "fading < 1, as noise": (
        lambda: ej.analysis.weighting_as_process_noise(SQUARE, SQUARE, SQUARE, 0.9),
        "fading: expected a number >= 1.0, got 0.9",
    ),
    "a covariance that is not one, as noise": (
        lambda: ej.analysis.weighting_as_process_noise(SQUARE, SQUARE, NOT_PSD, 1.1),
        "cov: expected a positive semidefinite matrix",
    ),
    # Anderson, continuous
    "a rate < 0, as noise": (
        lambda: ej.continuous.weighting_as_input_noise(SQUARE, SQUARE, -0.1),
        "fading_rate: expected a number >= 0.0, got -0.1",
    ),
    "noise of another size, as noise": (
        lambda: ej.continuous.weighting_as_input_noise(np.eye(3), SQUARE, 0.1),
        "noise: expected shape (2, 2), got shape (3, 3)",
    ),
    "R < 0, steady and continuous": (
        lambda: ej.continuous.steady_state_continuous(FLOW._replace(R=-np.eye(1))),
        "system.R: expected a positive definite matrix, got smallest eigenvalue -1",
    ),
    "a function, steady and continuous": (
        lambda: ej.continuous.steady_state_continuous(FLOW._replace(F=lambda p, t: SQUARE)),
        "system.F: expected a constant matrix, got a function",
    ),
    "F of another size, continuous": (
        lambda: bucy(F=np.eye(3)),
        "system.F: expected shape (2, 2), got shape (3, 3)",
    ),
    "F from a function, of another size": (
        lambda: bucy(F=lambda p, t: jnp.eye(3)),
        "system.F: expected shape (2, 2), got shape (3, 3)",
    ),
    "H of other measurements than the signal": (
        lambda: bucy(H=SQUARE, R=SQUARE),
        "system.H: expected shape (1, 2), got shape (2, 2)",
    ),
    "Q of another size than G": (
        lambda: bucy(Q=SQUARE),
        "system.Q: expected shape (1, 1), got shape (2, 2)",
    ),
    "R < 0, continuous": (
        lambda: bucy(R=np.array([[-0.5]])),
        "system.R: expected a positive definite matrix, got smallest eigenvalue -0.5",
    ),
    "R < 0 from a function at the start": (
        lambda: bucy(R=lambda p, t: -jnp.eye(1)),
        "system.R: expected a positive definite matrix, got smallest eigenvalue -1",
    ),
    "R a number, continuous": (
        lambda: bucy(R=0.5),
        "system.R: expected shape (., .), got shape ()",
    ),
    "a rate < 0 from a function at the start": (
        lambda: bucy(fading_rate=lambda p, t: jnp.asarray(-0.25)),
        "fading_rate: expected a number >= 0.0, got -0.25",
    ),
    "NaN in a signal": (
        lambda: bucy(signal=Signal(np.array([0.0, 1.0]), np.array([[0.0], [np.nan]]))),
        "signal.value: expected finite numbers, got nan at index (1, 0)",
    ),
    "no tolerance": (lambda: bucy(rtol=0.0), "rtol: expected a positive number, got 0.0"),
    "cov0 not PSD, continuous": (
        lambda: ej.continuous.actual_error_continuous(FLOW, None, NOT_PSD, times=[0.0, 1.0]),
        "cov0: expected a positive semidefinite matrix, got smallest eigenvalue -1",
    ),
    "a truth of another size": (
        lambda: ej.continuous.actual_error_continuous(
            FLOW, None, SQUARE, times=np.array([0.0, 1.0]), truth=FLOW._replace(F=np.eye(3))
        ),
        "truth.F: expected shape (2, 2), got shape (3, 3)",
    ),
    "times that do not increase, continuous": (
        lambda: ej.continuous.error_bounds_continuous(
            FLOW, None, SQUARE, times=np.array([1.0, 1.0])
        ),
        "times: expected at least two increasing times, got [1. 1.]",
    ),
    # delays
    "a sensor beyond the table": (
        lambda: by_sensor(np.array([1.0, 2.0]), np.array([0, 5])),
        "sensor: expected an index below 2, got 5",
    ),
    "a negative sensor, for a table": (
        lambda: by_sensor(np.array([1.0, 2.0]), -1),
        "sensor: expected an index >= 0, got -1",
    ),
    "losing more than everything": (
        lambda: losses(jax.random.key(0), 3, 5),
        "probability: expected a number between 0 and 1, got 3",
    ),
}


def weighted(**fields):
    return ej.analysis.weighted_covariances(SYSTEM._replace(**fields), SQUARE, fading=1.1, steps=3)


def bucy(signal=None, fading_rate=0.0, rtol=None, **fields):
    signal = Signal(np.array([0.0, 1.0]), np.zeros((2, 1))) if signal is None else signal
    return ej.kalman_bucy(
        FLOW._replace(**fields), None, signal, prior=PRIOR, times=np.array([0.0, 1.0]),
        fading_rate=fading_rate, rtol=rtol,
    )  # fmt: skip


def scalar():
    return Gaussian(np.zeros(1), np.eye(1))


def one():
    return jax.tree.map(lambda x: x[:1], STREAM)


def table_in_a_function():
    table = jnp.ones((2, 1, 2))
    return ej.kalman(ej.linear_model(SQUARE, lambda p, sensor, t: table[sensor], np.eye(1)))


def table_in_params():
    return ej.ewif(ej.linear_model(SQUARE, lambda p, sensor, t: p[sensor], np.eye(1)), 1.0)


@pytest.mark.parametrize("name", REFUSED)
def test_refused_in_words(name):
    attempt, message = REFUSED[name]
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        attempt()
    assert re.match(r"[\w.\[\]]+: expected .+, got .+", str(caught.value))


def test_a_sensor_index_is_checked_where_it_can_be_known():
    """Inside the table all is well; with `jit` over the indices nothing can be known."""
    stream = swap(sensor=np.array([0, 1, 1]))
    assert np.isfinite(run(table_in_a_function(), stream=stream).mean).all()

    @jax.jit
    def blind(sensor):
        return run(table_in_a_function(), stream=swap(sensor=sensor)).mean

    assert blind(np.array([0, 2, 1])).shape == (3, 2)


def test_indices_are_checked_inside_a_gradient_too():
    def loss(table):
        stream = swap(sensor=np.array([0, 2, 1]))
        return jnp.sum(run(table_in_params(), stream=stream, params=table).mean)

    with pytest.raises(ValueError, match=r"measurement.sensor: expected an index inside"):
        jax.grad(loss)(jnp.ones((2, 1, 2)))


def test_tables_are_looked_into_once_for_their_size_and_the_indices_they_hold():
    """Not for every new value, which would compile a program; `run` tries one arrival for each."""
    asked = []

    def H(p, sensor, t):
        asked.append(sensor)
        return p["H"][p["row"][sensor]]

    estimator, rng = ej.kalman(ej.linear_model(SQUARE, H, np.eye(1))), np.random.default_rng(0)

    def looks(rows, *where):
        asked.clear()
        params = {"H": rng.normal(size=(rows, 1, 2)), "row": np.array(where)}
        run(estimator, stream=swap(sensor=np.array([0, 1, 1])), params=params)
        return len(asked)

    assert looks(2, 0, 1) > 1
    assert looks(2, 0, 1) == 1
    for rows, *where in ((1, 0, 1), (2, 0, 5)):
        with pytest.raises(ValueError, match=r"measurement.sensor: expected an index inside"):
            looks(rows, *where)


def test_numpy_compiles_nothing_and_new_parameters_compile_nothing_again(caplog):
    """Neither a stream of sizes that nobody has had, nor a filter of one that it has had."""
    world = constant_velocity(sensors=position_sensor(0.5), q=lambda p: p["q"])
    time, value = np.arange(157.0), np.sin(np.arange(157.0))
    filters = ej.kalman(world), ej.ewif(world, lambda p: p["tau"])

    def filtered(numbers, stream):
        for estimator in filters:
            params = {"q": np.array(numbers), "tau": np.array(numbers)}
            ej.run(estimator, params, stream, prior=PRIOR, t0=0.0)

    def compiled():
        told = [record.message for record in caplog.records]
        caplog.clear()
        return [x for x in told if x.startswith("Compiling")]

    with jax.log_compiles():
        stream = ej.stream(time, value)
        assert not compiled()
        filtered(1.0, stream)
        assert compiled()
        filtered(2.0, stream)
        assert not compiled()


def test_a_batch_looks_again_at_what_is_not_the_same(monkeypatch):
    looks = []
    look = every_run.check_runs
    monkeypatch.setattr(every_run, "check_runs", lambda *args: looks.append(0) or look(*args))
    stream = Measurement(*map(jnp.asarray, STREAM))
    stream = stream._replace(value=jnp.ones((2, 3, 1)), sensor=jnp.zeros(3, jnp.int32))
    prior = Gaussian(*map(jnp.asarray, PRIOR))
    model = constant_velocity(sensors=position_sensor(0.5))
    estimator = ej.ewif(model, lambda tau: tau)

    def means(tau, measurements=stream, t0=0.0):
        return batch.run_batch(
            estimator, tau, measurements, prior=prior, t0=t0, observe=lambda step, _: step.mean
        )

    tau, bad = jnp.asarray(0.2), jnp.asarray(-0.2)
    np.testing.assert_array_equal(means(tau), means(tau))
    assert len(looks) == 1
    for _ in range(2):
        with pytest.raises(ValueError, match=r"tau: expected a positive number, got -0\.2"):
            means(bad)
        with pytest.raises(ValueError, match=r"measurement\.sensor: expected an index below 1"):
            means(tau, stream._replace(sensor=jnp.array([0, 1, 0])))
        with pytest.raises(ValueError, match="t0: expected finite numbers"):
            means(tau, t0=np.inf)
    masked = stream._replace(mask=jnp.zeros((3, 1), bool))
    np.testing.assert_allclose(means(tau, masked)[0, -1], [0.3 - 0.3, -1.0], atol=1e-6)


def test_a_function_that_branches_on_the_sensor_is_not_a_table():
    model = ej.linear_model(
        SQUARE, lambda p, sensor, t: jnp.where(sensor == 0, 1.0, 2.0) * jnp.ones((1, 2)), np.eye(1)
    )
    stream = swap(sensor=np.array([0, 7, 3]))
    assert np.isfinite(run(ej.kalman(model), stream=stream).mean).all()


def test_what_is_missing_may_be_nan():
    value = np.array([[1.0], [np.nan], [1.0]])
    trace = run(stream=swap(value=value, mask=np.isfinite(value)))
    assert np.isfinite(trace.mean).all()
    np.testing.assert_array_equal(ej.stream(STREAM.time, value).mask, np.isfinite(value))


@pytest.mark.filterwarnings("error")
def test_what_float32_cannot_hold_is_missing():
    with jax.enable_x64(False):
        stream = ej.stream([1.0, 2.0], [1.0, 1e200])
        assert {x.dtype.name for x in stream} == {"float32", "int32", "bool"}
        np.testing.assert_array_equal(stream.mask[:, 0], [True, False])
        np.testing.assert_array_equal(stream.value[:, 0], [1.0, 0.0])


def test_a_measurement_older_than_t0_is_late_and_not_an_error():
    info = run(t0=0.25).info
    np.testing.assert_array_equal(
        info.status, [ej.Status.TOO_LATE, ej.Status.TOO_LATE, ej.Status.USED]
    )


def test_a_state_never_runs_backwards():
    trace = run(stream=swap(time=np.array([0.3, 0.1, 0.2])))
    np.testing.assert_array_equal(trace.time, [0.3, 0.3, 0.3])
    assert trace.final_state.time == 0.3


def test_plain_lists_will_do():
    prior = Gaussian([0.3, -1.0], [[2.0, 0.0], [0.0, 0.5]])
    stream = Measurement([0.1, 0.2, 0.3], [[1.0]] * 3, [0, 1, 0], [[True]] * 3)
    np.testing.assert_allclose(run(stream=stream, prior=prior).mean, run().mean, rtol=1e-12)


SHAPES = st.lists(st.integers(0, 3), max_size=3).map(tuple)
SPECIAL = st.sampled_from([0.0, 1.0, -2.0, 1e30, np.nan, np.inf])


def arrays(kind):
    return st.builds(lambda shape, fill: np.full(shape, fill).astype(kind), SHAPES, SPECIAL)


FIELDS = {
    "time": arrays(float),
    "value": arrays(float),
    "sensor": st.builds(lambda shape, fill: np.full(shape, fill), SHAPES, st.integers(-1, 3)),
    "mask": st.builds(lambda shape, fill: np.full(shape, fill), SHAPES, st.booleans()),
    "mean": arrays(float),
    "cov": arrays(float),
    "t0": arrays(float),
    "times": arrays(float),
}
NAMES = r"measurements?(\.\w+)?|prior(\.\w+)?|t0|times|F|H|R|Q"


@pytest.mark.parametrize("estimator", [KALMAN, EWIF], ids=["kalman", "ewif"])
@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(field=st.sampled_from(sorted(FIELDS)), data=st.data())
def test_anything_else_runs_or_is_refused_by_name(estimator, field, data):
    """One field at a time is arbitrary: it is either refused by name, or gives finite numbers."""
    bad = data.draw(FIELDS[field])
    options = {"stream": STREAM, "prior": PRIOR, "t0": 0.0}
    if field in Measurement._fields:
        options["stream"] = swap(**{field: bad})
    elif field in Gaussian._fields:
        options["prior"] = PRIOR._replace(**{field: bad})
    else:
        options[field] = bad
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            trace = run(estimator, **options)
        except (ValueError, TypeError) as raised:
            refusal = str(raised)
        else:
            refusal = None
    if refusal is not None:
        assert re.match(rf"({NAMES}): expected .+, got ", refusal)
        return
    usual = np.abs(bad).max(initial=0) < 1e20 and field != "times"
    if usual:
        assert np.isfinite(trace.mean).all()
