"""Over simulated worlds errors are as large as the filters say, late data included."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from late_streams import problem

import ewif_jax as ej
from ewif_jax.models import constant_velocity, position_sensor

RUNS, MEMBERS, PARTICLES, LAG = 600, 300, 400, 3
TIMES, LATE = (0.4, 1.1), 0.8
PROBLEM = problem(7, 3, 1)
FILTERS = {
    "unscented": ej.unscented(PROBLEM.model),
    "stochastic": ej.ensemble(PROBLEM.model, MEMBERS),
    "square_root": ej.ensemble(PROBLEM.model, MEMBERS, "square_root"),
}
BEND, DENSITY, NOISE = 0.04, 0.3, 0.2
PRIOR = ej.Gaussian(np.array([1.0, -0.5]), np.diag([0.5, 0.3]))


def bent():
    """Constant velocity, and a position that is measured on a slightly bent scale."""
    linear = constant_velocity(sensors=position_sensor(NOISE), q=DENSITY)

    def observe(params, x, sensor, t):
        return x[:1] + BEND * x[:1] ** 2

    return linear._replace(observe=observe, linear=None)


MODEL = bent()
IN_SEQUENCE = {
    "extended": ej.extended(MODEL),
    "unscented": ej.unscented(MODEL),
    "ensemble": ej.ensemble(MODEL, MEMBERS),
    "bootstrap": ej.bootstrap(MODEL, PARTICLES),
}
LATE_USERS = {
    "al1": ej.al1(MODEL, LAG),
    "asd": ej.asd(MODEL, LAG),
    "enkf2, shared": ej.enkf2(MODEL, MEMBERS, LAG, "shared"),
    "pf_extended": ej.pf_extended(MODEL, PARTICLES, LAG),
    "pf_fixed_point": ej.pf_fixed_point(MODEL, PARTICLES, LAG),
}
SAMPLES = {"stochastic": MEMBERS, "square_root": MEMBERS, "ensemble": MEMBERS,
           "enkf2, shared": MEMBERS, "bootstrap": PARTICLES, "pf_extended": PARTICLES,
           "pf_fixed_point": PARTICLES}  # fmt: skip


def agree(name, statistic, freedom):
    """The mean of every column is that of chi-square, within 4 standard errors and, for N samples,
    6 / N of it (the covariance of a finite sample is inverted)."""
    share = 6 / SAMPLES[name] if name in SAMPLES else 0
    gap = np.abs(np.asarray(statistic).mean(0) - freedom)
    assert np.all(gap < 4 * np.sqrt(2 * freedom / RUNS) + share * freedom)


def simulated():
    """True states (RUNS, 2, n) and values (RUNS, 2) of worlds drawn from prior and noise."""
    rng, world = np.random.default_rng(11), PROBLEM.oracle

    def drawn(cov):
        values, vectors = np.linalg.eigh(cov)
        root = vectors * np.sqrt(np.maximum(values, 0))
        return rng.normal(size=(RUNS, len(cov))) @ root.T

    x, now, truth, seen = world["prior_mean"] + drawn(world["prior_cov"]), 0.0, [], []
    for sensor, t in enumerate(TIMES):
        x = x @ world["F"](now, t).T + world["b"](now, t) + drawn(world["Q"](now, t))
        truth.append(x)
        seen.append(x @ PROBLEM.H[sensor].T + drawn(PROBLEM.R[sensor]))
        now = t
    return np.stack(truth, 1), np.stack(seen, 1)


def bent_worlds():
    """True states (RUNS, 3, 2) at the times in order, and values (RUNS, 3, 1)."""
    rng = np.random.default_rng(5)
    x, now, truth = rng.multivariate_normal(PRIOR.mean, PRIOR.cov, RUNS), 0.0, []
    for t in sorted((*TIMES, LATE)):
        dt = t - now
        Q = DENSITY * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        x = x @ np.array([[1, dt], [0, 1]]).T + rng.multivariate_normal(np.zeros(2), Q, RUNS)
        truth.append(x)
        now = t
    truth = np.stack(truth, 1)
    place = truth[..., :1]
    values = place + BEND * place**2 + np.sqrt(NOISE) * rng.normal(size=place.shape)
    return truth, values


def bent_stream(order):
    """The measurements of `bent_worlds` in an order of arrival."""
    truth, values = bent_worlds()
    times = np.sort([*TIMES, LATE])[order]
    data = ej.Measurement(
        jnp.asarray(times), jnp.asarray(values[:, order]), jnp.zeros(3, jnp.int32),
        jnp.ones((3, 1), bool),
    )  # fmt: skip
    return truth, data


@pytest.mark.parametrize("name", FILTERS)
def test_errors_and_innovations(name):
    truth, values = simulated()
    data = ej.Measurement(
        jnp.asarray(TIMES),
        jnp.asarray(values),
        jnp.arange(2, dtype=jnp.int32),
        jnp.ones((2, 1), bool),
    )
    key = jax.random.key(5)
    trace = ej.run_batch(FILTERS[name], None, data, prior=PROBLEM.prior, t0=0.0, key=key)
    agree(name, ej.nees(trace.mean, trace.cov, truth), 3)
    agree(name, ej.nis(trace.info), 1)


@pytest.mark.parametrize(
    "name",
    # The bootstrap filter is a part of the other particle filters.
    [pytest.param(name, marks=pytest.mark.slow if name == "bootstrap" else ())
     for name in (*IN_SEQUENCE, *LATE_USERS)],
)  # fmt: skip
def test_on_a_mildly_nonlinear_model(name):
    """The last measurement is late for the methods that can use it."""
    late = name in LATE_USERS
    order = np.array([0, 2, 1] if late else [0, 1, 2])
    truth, data = bent_stream(order)
    estimator = (IN_SEQUENCE | LATE_USERS)[name]
    trace = ej.run_batch(estimator, None, data, prior=PRIOR, t0=0.0, key=jax.random.key(6))
    status = [ej.Status.USED, ej.Status.USED, ej.Status.LATE_USED if late else ej.Status.USED]
    assert (np.asarray(trace.info.status) == status).mean() > 0.99
    agree(name, ej.nees(trace.mean, trace.cov, truth[:, np.maximum.accumulate(order)]), 2)
    agree(name, ej.nis(trace.info), 1)


def test_the_smoother_on_a_mildly_nonlinear_model():
    truth, data = bent_stream(np.arange(3))

    def one(value):
        return ej.rts(MODEL, None, data._replace(value=value), prior=PRIOR, t0=0.0)

    smoothed = jax.jit(jax.vmap(one))(data.value)
    agree("rts", ej.nees(smoothed.mean, smoothed.cov, truth), 2)


def test_runs_have_noise_of_their_own_and_a_batch_is_its_runs():
    data = ej.stream(TIMES, [0.3, -0.2], [0, 1])
    batch = jax.tree.map(lambda x: jnp.stack([x] * 4), data)
    options, key = {"prior": PROBLEM.prior, "t0": 0.0}, jax.random.key(5)
    estimator = ej.ensemble(PROBLEM.model, 10)
    together = ej.run_batch(estimator, None, batch, key=key, **options)
    for k, own in enumerate(jax.random.split(key, 4)):
        alone = ej.run(estimator, None, data, key=own, **options)
        np.testing.assert_allclose(together.mean[k], alone.mean, atol=1e-10)
    assert np.unique(together.mean[:, -1, 0]).size == 4
