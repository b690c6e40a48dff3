"""The iterated extended filter is Gauss-Newton on the cost of each update, angles wrapped."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.models import bearing_sensor, constant_velocity
from laws.cases import case, close, model

POSITIONS = ((1.0, 0.5), (-1.0, 2.0))
PARAMS = {"q": 0.1, "r": 0.01}
WORLD = constant_velocity(
    sensors=[bearing_sensor(lambda p: p["r"], p) for p in POSITIONS], dims=2, q=lambda p: p["q"]
)
PRIOR = ej.Gaussian(np.array([-0.5, 0.6, 0.3, -0.1]), np.diag([0.5, 0.4, 0.1, 0.1]))
TIMES = np.array([0.4, 1.0, 1.0, 1.7, 2.5])
SENSORS = np.array([0, 1, 0, 0, 1])
VALUES = np.array([3.1, -1.2, -3.1, 3.0, -0.7])
STREAM = ej.stream(TIMES, VALUES[:, None], SENSORS)
START = {"prior": PRIOR, "t0": 0.0}


def bearing(x, sensor):
    return np.arctan2(x[1] - POSITIONS[sensor][1], x[0] - POSITIONS[sensor][0])


def slope(x, sensor):
    east, north = x[:2] - POSITIONS[sensor]
    return np.array([-north, east, 0.0, 0.0]) / (east**2 + north**2)


def wrapped(angle):
    return np.angle(np.exp(1j * angle))


def oracle(steps):
    """Mean and covariance after each measurement, innovation, its variance; NumPy."""
    x, P, last = PRIOR.mean, PRIOR.cov, 0.0
    q, r, found = PARAMS["q"], PARAMS["r"], []
    for t, z, s in zip(TIMES, VALUES, SENSORS, strict=True):
        dt, last = t - last, t
        F = np.kron([[1, dt], [0, 1]], np.eye(2))
        x = F @ x
        P = F @ P @ F.T + q * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
        h = slope(x, s)
        info = wrapped(z - bearing(x, s)), h @ P @ h + r
        y, information = x, np.linalg.inv(P)
        for _ in range(steps):
            # The normal equations of the cost, not a gain: another way to the same step.
            h, off = slope(y, s), wrapped(z - bearing(y, s))
            right = h * off / r - information @ (y - x)
            y = y + np.linalg.solve(information + np.outer(h, h) / r, right)
        x, P = y, np.linalg.inv(information + np.outer(h, h) / r)
        found.append((x, P, *info))
    return found


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_so_many_steps(steps):
    trace = ej.run(ej.iterated_extended(WORLD, iterations=steps), PARAMS, STREAM, **START)
    expected = oracle(steps)
    close(trace.mean, [x for x, *_ in expected], 1e-10)
    close(trace.cov, [P for _, P, *_ in expected], 1e-10)
    nu, S = (np.array([row[k] for row in expected]) for k in (2, 3))
    close(trace.info.innovation[:, 0], nu, 1e-10)
    close(trace.info.innovation_cov[:, 0, 0], S, 1e-10)
    close(trace.info.log_likelihood, -0.5 * (nu**2 / S + np.log(2 * np.pi * S)), 1e-9)
    if steps == 1:
        extended = ej.run(ej.extended(WORLD), PARAMS, STREAM, **START)
        jax.tree.map(np.testing.assert_array_equal, tuple(trace[:4]), tuple(extended[:4]))


def test_many_steps_end_where_the_cost_has_no_slope():
    update = ej.iterated_extended(WORLD, iterations=40).update
    state = ej.iterated_extended(WORLD).init(PARAMS, PRIOR, 0.0)
    far = 2.2
    first = ej.Measurement(jnp.zeros(()), jnp.array([far]), jnp.int32(0), jnp.array([True]))
    moved, _ = jax.jit(update)(PARAMS, state, first)

    def cost(x):
        off = wrapped(far - bearing(x, 0))
        d = x - PRIOR.mean
        return d @ np.linalg.solve(PRIOR.cov, d) + off**2 / PARAMS["r"]

    x = np.asarray(moved.mean)
    quotient = [(cost(x + h) - cost(x - h)) / 2e-6 for h in 1e-6 * np.eye(4)]
    start = [(cost(PRIOR.mean + h) - cost(PRIOR.mean - h)) / 2e-6 for h in 1e-6 * np.eye(4)]
    assert np.abs(quotient).max() < 1e-7 * np.abs(start).max()
    one_step, _ = jax.jit(ej.extended(WORLD).update)(PARAMS, state, first)
    assert cost(x) < 0.9 * cost(np.asarray(one_step.mean))


def test_of_a_linear_model_any_number_of_steps_is_kalman():
    """As matrices, and as functions that happen to be linear; masks included."""
    world = case(14, 3)
    functions = ej.Model(
        model().transition, model().process_cov, model().observe, model().measurement_cov
    )
    options = {"prior": world.prior, "t0": 0.0}
    expected = ej.run(ej.kalman(model()), world.params, world.stream(), **options)
    for same in (model(), functions):
        found = ej.run(ej.iterated_extended(same, 4), world.params, world.stream(), **options)
        for a, b in ((found.mean, expected.mean), (found.cov, expected.cov)):
            close(a, b, 1e-10)
        close(found.info.log_likelihood, expected.info.log_likelihood, 1e-10)


ORDER = [0, 1, 3, 4, 2]
LATE = jax.tree.map(lambda x: x[np.array(ORDER)], STREAM)


def test_late_through_replay_batches_float32_and_gradients():
    """The last estimate is that of the sorted stream; a batch is single runs; the gradient is the
    quotient."""
    filtered = ej.iterated_extended(WORLD, iterations=3)
    late = ej.run(ej.replay(filtered, 4, width=1), PARAMS, LATE, **START)
    close(late.mean[-1], oracle(3)[-1][0], 1e-10)
    both = jax.tree.map(lambda *x: jnp.stack(x), STREAM, LATE)
    batch = ej.run_batch(filtered, PARAMS, both, **START)
    for k, stream in enumerate((STREAM, LATE)):
        alone = ej.run(filtered, PARAMS, stream, **START)
        close(batch.mean[k], alone.mean, 1e-12)
        np.testing.assert_array_equal(batch.info.status[k], alone.info.status)
    single = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == float else x, STREAM)
    prior = ej.Gaussian(*(np.float32(x) for x in PRIOR))
    found = ej.run(filtered, PARAMS, single, prior=prior, t0=np.float32(0))
    assert found.mean.dtype == np.float32
    close(found.mean, [x for x, *_ in oracle(3)], 1e-4)

    def loss(params):
        trace = ej.run(filtered, params, STREAM, **START)
        return jnp.sum(trace.mean**2) + jnp.sum(trace.info.log_likelihood)

    slopes = jax.jit(jax.grad(loss))(PARAMS)
    value = jax.jit(loss)
    for name, x in PARAMS.items():
        up, down = (value({**PARAMS, name: x * (1 + h)}) for h in (1e-6, -1e-6))
        np.testing.assert_allclose(slopes[name], (up - down) / (2e-6 * x), rtol=1e-6)


def test_a_step_that_is_not_a_number_is_refused_and_changes_nothing():
    """A root that exists at the prediction and not where the first step leads."""
    root = ej.Model(
        lambda p, x, t0, t1: x,
        lambda p, t0, t1: jnp.zeros((1, 1)),
        lambda p, x, s, t: jnp.sqrt(x),
        lambda p, s, t: jnp.full((1, 1), 0.01),
    )
    state = ej.iterated_extended(root, 3).init(None, ej.Gaussian(np.ones(1), np.eye(1)), 0.0)

    def after(value):
        z = ej.Measurement(jnp.zeros(()), jnp.array([value]), jnp.int32(0), jnp.array([True]))
        return jax.jit(ej.iterated_extended(root, 3).update)(None, state, z)

    moved, info = after(-2.0)
    assert info.status == ej.Status.REJECTED
    jax.tree.map(np.testing.assert_array_equal, moved, state)
    assert after(1.2)[1].status == ej.Status.USED


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="iterations: expected a whole number >= 1"):
        ej.iterated_extended(WORLD, iterations=0)
    with pytest.raises(ValueError, match="model: expected a Model"):
        ej.iterated_extended(PARAMS)
