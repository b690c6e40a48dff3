"""Uncertain stamps are measurement noise along the predicted motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.models import constant_velocity, jittered, position_sensor
from laws.cases import close

SENSOR = position_sensor(0.04, dims=2)
PLAIN = constant_velocity(sensors=SENSOR, q=0.01, dims=2)
MODEL = jittered(PLAIN, lambda p: p["s"])
PARAMS = {"s": 0.1}
PRIOR = ej.Gaussian(np.array([0.0, 0.0, 10.0, -4.0]), np.diag([0.04, 0.04, 0.1, 0.1]))
TIMES = np.array([0.5, 1.0, 2.0, 2.5])
VALUES = np.stack([10.0 * TIMES, -4.0 * TIMES], -1) + np.array([[0.3, 0.1], [-0.4, 0.0]] * 2)
STREAM = ej.stream(TIMES, VALUES)


def by_hand(sigma: float) -> tuple[np.ndarray, np.ndarray, float]:
    """The Kalman filter with R + (H f)(H f)' sigma^2, f the predicted velocity."""
    x, P, now, total = PRIOR.mean, PRIOR.cov, 0.0, 0.0
    H = np.eye(2, 4)
    for time, value in zip(TIMES, VALUES, strict=True):
        dt, now = time - now, time
        F = np.eye(4) + dt * np.eye(4, k=2)
        Q = 0.01 * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(2))
        x, P = F @ x, F @ P @ F.T + Q
        S = H @ P @ H.T + 0.04 * np.eye(2) + sigma**2 * np.outer(x[2:], x[2:])
        nu = value - H @ x
        total -= 0.5 * (nu @ np.linalg.solve(S, nu) + np.log(np.linalg.det(2 * np.pi * S)))
        K = P @ H.T @ np.linalg.inv(S)
        x, P = x + K @ nu, P - K @ H @ P
    return x, P, total


def test_it_is_the_filter_with_that_noise_and_so_is_its_gradient():
    @jax.jit
    def total(s):
        trace = ej.run(ej.kalman(MODEL), {"s": s}, STREAM, prior=PRIOR, t0=0.0)
        return jnp.sum(trace.info.log_likelihood), trace

    (likelihood, trace), slope = jax.value_and_grad(total, has_aux=True)(jnp.asarray(0.1))
    mean, cov, expected = by_hand(0.1)
    close(trace.mean[-1], mean)
    close(trace.cov[-1], cov)
    np.testing.assert_allclose(likelihood, expected, rtol=1e-12)
    numeric = (by_hand(0.1 + 1e-6)[2] - by_hand(0.1 - 1e-6)[2]) / 2e-6
    np.testing.assert_allclose(slope, numeric, rtol=1e-6)


METHODS = {
    "information": ej.information,
    "square_root": ej.square_root,
    "ewif": lambda model: ej.ewif(model, 1e3),
    "extended": ej.extended,
    "unscented": ej.unscented,
    "asd": lambda model: ej.asd(model, 2),
    "al1": lambda model: ej.al1(model, 2),
    "ensemble": lambda model: ej.ensemble(model, 8),
    "bootstrap": lambda model: ej.bootstrap(model, 8),
}
SLOW = ("information", "square_root", "asd", "al1", "unscented")
"""Whose way to R others share; checked with --all."""


@pytest.mark.parametrize(
    "build",
    [
        pytest.param(b, id=n, marks=pytest.mark.slow if n in SLOW else ())
        for n, b in METHODS.items()
    ],
)
def test_every_method_expects_that_much_more(build):
    """At t0, where the mean and the covariance are the prior's."""
    one = ej.stream([0.0], np.zeros((1, 2)))
    prior = PRIOR._replace(cov=np.diag([0.04, 0.04, 1e-12, 1e-12]))
    found, plain = (
        ej.run(build(m), PARAMS, one, prior=prior, t0=0.0, key=jax.random.key(0))
        for m in (MODEL, PLAIN)
    )
    more = np.asarray(found.info.innovation_cov - plain.info.innovation_cov)[0]
    np.testing.assert_allclose(more, 0.01 * np.outer([10, -4], [10, -4]), rtol=1e-5)


def test_a_late_measurement_gets_the_noise_of_its_time():
    """A target that turns: replay in the order of time is the filter in that order."""
    model = ej.models.coordinated_turn(sensors=SENSOR, q=0.01, q_turn=1e-4)
    model = jittered(model, 0.1)
    prior = ej.Gaussian(np.append(PRIOR.mean, 0.8), np.diag([0.04, 0.04, 0.1, 0.1, 0.01]))
    order = np.array([0, 1, 3, 2])
    late = ej.stream(TIMES[order], VALUES[order])
    replayed = ej.run(ej.replay(ej.extended(model), 4), None, late, prior=prior, t0=0.0)
    sorted_ = ej.run(ej.extended(model), None, STREAM, prior=prior, t0=0.0)
    close(replayed.mean[-1], sorted_.mean[-1], 1e-12)
    close(replayed.cov[-1], sorted_.cov[-1], 1e-12)


def test_zero_jitter_is_the_model_itself_in_a_batch_too():
    each = jnp.asarray([0.0, 0.1])
    batch = jax.tree.map(
        lambda x: jnp.stack([x, x + 1 if x.ndim == 2 else x]),
        STREAM._replace(mask=STREAM.mask.astype(float)),
    )
    batch = batch._replace(mask=jnp.ones_like(batch.mask, bool))
    many = ej.run_batch(
        ej.kalman(MODEL), {"s": each}, batch, prior=PRIOR, t0=0.0, params_per_run=True
    )
    plain = ej.run(ej.kalman(PLAIN), None, STREAM, prior=PRIOR, t0=0.0)
    close(many.mean[0], plain.mean, 1e-12)
    other = STREAM._replace(value=batch.value[1])
    close(many.mean[1], ej.run(ej.kalman(MODEL), PARAMS, other, prior=PRIOR, t0=0.0).mean, 1e-12)


def test_the_filter_is_consistent_only_if_it_knows_of_the_jitter():
    runs, steps, sigma = 40, 20, 0.1
    rng = np.random.default_rng(5)
    start = rng.multivariate_normal(PRIOR.mean, PRIOR.cov, runs)
    times = np.arange(1, steps + 1) * 0.5
    F = np.eye(4) + 0.5 * np.eye(4, k=2)
    Q = 0.01 * np.kron(np.array([[0.125 / 3, 0.125], [0.125, 0.5]]), np.eye(2))
    truth = [start]
    for _ in times:
        truth.append(truth[-1] @ F.T + rng.multivariate_normal(np.zeros(4), Q, runs))
    truth = np.stack(truth[1:], 1)
    late = sigma * rng.normal(size=(runs, steps, 1))
    values = truth[..., :2] + late * truth[..., 2:] + 0.2 * rng.normal(size=(runs, steps, 2))
    stream = ej.types.Measurement(
        times, values, np.zeros(steps, np.int32), np.ones((steps, 2), bool)
    )
    low, high = ej.analysis.chi2_band(4, runs)

    def average(model: ej.Model) -> float:
        found = ej.run_batch(ej.kalman(model), PARAMS, stream, prior=PRIOR, t0=0.0)
        apart = np.asarray(found.mean[:, -1]) - truth[:, -1]
        return float(
            np.mean(np.einsum("ri,rij,rj->r", apart, np.linalg.inv(found.cov[:, -1]), apart))
        )

    assert low < average(MODEL) < high
    assert average(PLAIN) > 1.5 * high


def test_the_rate_counts_inputs_and_the_ships_own_motion():
    """x' = u at the filter's time, and a ship that sails away."""
    model = jittered(
        ej.models.random_walk(
            sensors=position_sensor(0.0, 2, position=lambda p, t: jnp.stack([3.0 * t, 0.0 * t])),
            dims=2,
            b=lambda p, t0, t1: (t1 - t0) * jnp.asarray([1.0, 5.0]),
        ),
        1.0,
    )
    R = model.jitter(None, jnp.zeros(2), jnp.int32(0), jnp.asarray(2.0))
    np.testing.assert_allclose(R, np.outer([-2.0, 5.0], [-2.0, 5.0]), rtol=1e-12)


DISCRETE = ej.linear_model(np.eye(2), np.eye(2), np.eye(2), np.eye(2))
REFUSED = {
    "a model in discrete time": (
        lambda: jittered(DISCRETE, 0.1),
        "model: expected a model in continuous time, whose state has a rate (functions of (params, "
        "t0, t1), a kinematic model, models.from_continuous), got a model in discrete time",
    ),
    "no model": (
        lambda: jittered(SENSOR, 0.1),
        "model: expected a Model (linear_model(...), models.*) for jittered, got a Sensor",
    ),
    "below 0": (
        lambda: jittered(PLAIN, -0.1),
        "sigma_t: expected a number >= 0.0, got -0.1",
    ),
    "as many as there are not": (
        lambda: jittered(PLAIN, [0.1, 0.2]),
        "sigma_t: expected shape (1,), got shape (2,)",
    ),
}
NEEDS = (
    "model: expected a model whose R does not depend on the state: {} needs it before there is "
    "one, got a jittered model"
)
BEFORE = {
    "batch_wls": lambda: ej.batch_wls(MODEL, PARAMS, STREAM, TIMES, weight=lambda p, a, b: 1.0),
    "two_sided_ewif": lambda: ej.two_sided_ewif(MODEL, PARAMS, STREAM, tau=1.0),
    "run_parallel": lambda: ej.run_parallel(MODEL, PARAMS, STREAM, tau=1.0, prior=PRIOR, t0=0.0),
    "limited_memory": lambda: ej.limited_memory(MODEL, 2.0, 8),
}
REFUSED |= {name: (call, NEEDS.format(name)) for name, call in BEFORE.items()}


@pytest.mark.parametrize(("build", "said"), REFUSED.values(), ids=REFUSED)
def test_what_is_refused(build, said):
    with pytest.raises(ValueError, match="expected") as error:
        build()
    assert str(error.value) == said
