"""Particle filters where something is degenerate: finite numbers and a status that says so."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax import Status
from ewif_jax.estimators.bootstrap import bootstrap
from ewif_jax.models import bearing_sensor, constant_velocity, position_sensor
from ewif_jax.oosm.pf_extended import pf_extended
from ewif_jax.oosm.pf_fixed_point import pf_fixed_point
from ewif_jax.oosm.pf_retrodict import pf_retrodict

PRIOR = ej.Gaussian(np.array([10.0, 1.0]), np.diag([4.0, 1.0]))
KEY = jax.random.key(0)
LINE = constant_velocity(sensors=position_sensor(lambda p: p["r"]), q=lambda p: p["q"])
PARAMS = {"q": jnp.asarray(0.3), "r": jnp.asarray(0.5)}
DATA = ej.stream(np.array([1.0, 2.0, 1.5, 3.0]), np.array([11.0, 12.0, 11.4, 13.1]))
LATE = 2
REFUSED = (Status.TOO_LATE, Status.REJECTED)
BUILD = {
    "bootstrap": bootstrap,
    "retrodict": pf_retrodict,
    "extended": lambda model, count: pf_extended(model, count, 3),
    "eks": lambda model, count: pf_fixed_point(model, count, 3),
    "ps": lambda model, count: pf_fixed_point(model, count, 3, "ps", smoother_particles=2),
}


def measured(time, value):
    """One component, present whatever its value."""
    value = jnp.atleast_1d(jnp.asarray(value))
    present = jnp.ones(value.shape, bool)
    return ej.Measurement(jnp.asarray(time), value, jnp.asarray(0, jnp.int32), present)


@pytest.mark.parametrize("name", BUILD)
def test_two_particles_and_no_process_noise(name):
    """With finite gradients; a density in x(k) that does not exist rejects the late measurement."""
    method = BUILD[name](LINE, 2)

    def loss(params):
        trace = ej.run(method, params, DATA, prior=PRIOR, t0=0.0, key=KEY)
        return jnp.sum(trace.mean) + jnp.sum(trace.info.log_likelihood), trace

    params = {**PARAMS, "q": jnp.asarray(0.0)}
    (_, trace), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(params)
    expected = {"bootstrap": Status.TOO_LATE, "ps": Status.REJECTED}.get(name, Status.LATE_USED)
    assert trace.info.status[LATE] == expected
    leaves = jax.tree.leaves((trace.mean, trace.cov, trace.info, gradient))
    assert all(np.isfinite(x).all() for x in leaves)


@pytest.mark.parametrize("name", BUILD)
def test_a_measurement_that_no_particle_explains_is_rejected(name):
    """In sequence and late, in `update` itself, where nothing has looked at the value before; the
    filter goes on, and gradients are finite."""
    method = BUILD[name](LINE, 100)

    def both(params, z):
        state = method.init(params, PRIOR, 0.0, KEY)
        state, _ = method.update(params, method.predict(params, state, 1.0), measured(1.0, 11.0))
        state = method.predict(params, state, 2.0)
        after, info = method.update(params, state, z)
        value = jnp.sum(method.estimate(params, after).mean) + info.log_likelihood
        return value, (state, after, info)

    told = jax.jit(jax.grad(both, has_aux=True))
    for time in (2.0, 1.5):
        late_used = time < 2 and name != "bootstrap"
        for value in (np.nan, np.inf, -1e200):
            gradient, (state, after, info) = told(PARAMS, measured(time, value))
            refused = Status.REJECTED if time == 2 or late_used else Status.TOO_LATE
            assert info.status == refused
            assert info.log_likelihood == 0
            assert all(np.isfinite(x).all() for x in jax.tree.leaves((info, gradient)))
            assert info.innovation_cov[0, 0] > 0
            np.testing.assert_array_equal(after.log_weights, state.log_weights)
            np.testing.assert_array_equal(after.particles, state.particles)
        _, (_, after, info) = told(PARAMS, measured(time, 12.0))
        assert info.status == (Status.LATE_USED if late_used else refused if time < 2 else 0)
        assert np.isfinite(method.estimate(PARAMS, after).cov).all()


@pytest.mark.parametrize("name", BUILD)
def test_a_sensor_that_sees_nothing_at_one_time_is_rejected_there(name):
    """NaN from `observe`, within `run`: in sequence at 2 s, late at 1.5 s."""

    def observe(params, x, sensor, t):
        return jnp.where(t == params["blind"], jnp.nan, x[:1])

    method = BUILD[name](LINE._replace(observe=observe, linear=None), 100)

    @jax.jit
    def ran(blind):
        return ej.run(method, {**PARAMS, "blind": blind}, DATA, prior=PRIOR, t0=0.0, key=KEY)

    for blind, where in ((2.0, 1), (1.5, 2)):
        trace = ran(blind)
        late = Status.TOO_LATE if name == "bootstrap" else Status.LATE_USED
        expected = np.array([Status.USED, Status.USED, late, Status.USED])
        if where == 1 or name != "bootstrap":
            expected[where] = Status.REJECTED
        np.testing.assert_array_equal(trace.info.status, expected)
        assert all(np.isfinite(x).all() for x in (trace.mean, trace.cov, *trace.info))
        if where == 2:
            np.testing.assert_array_equal(trace.mean[2], trace.mean[1])


@partial(jax.jit, static_argnums=0)
def first_update(method, params, prior, value):
    """The state at the start, and what a measurement makes of it."""
    state = method.init(params, prior, 0.0, KEY)
    return state, method.update(params, state, measured(0.0, value))


def test_a_sensor_without_noise_is_rejected():
    _, (_, info) = first_update(bootstrap(LINE, 100), {**PARAMS, "r": 0.0}, PRIOR, 10.0)
    assert info.status == Status.REJECTED


def test_particles_that_cannot_be_observed_lose_their_weight():
    """A sensor that sees only what is ahead of 10 m: the others give NaN."""
    blind = LINE._replace(observe=lambda p, x, s, t: jnp.sqrt(x[:1] - 10.0), linear=None)
    method = bootstrap(blind, 1000)
    state, (after, info) = first_update(method, PARAMS, PRIOR, 1.0)
    assert info.status == Status.USED
    behind = np.asarray(state.particles[0]) < 10.0
    assert behind.sum() > 300
    np.testing.assert_array_equal(np.isneginf(after.log_weights), behind)
    assert all(np.isfinite(x).all() for x in (*info, *method.estimate(PARAMS, after)))
    moved = method.predict(PARAMS, after, jnp.asarray(1e-9))
    assert float(moved.particles[0].min()) > 9.9


def test_bearings_wrap():
    """A target due west, on both sides of the cut: the innovation is small, not 2 pi."""
    model = constant_velocity(sensors=bearing_sensor(0.01**2), q=0.0, dims=2)
    prior = ej.Gaussian(np.array([-100.0, 0.0, 0.0, 0.0]), np.diag([1.0, 1.0, 0.0, 0.0]))
    _, (_, info) = first_update(bootstrap(model, 500), None, prior, -np.pi + 0.01)
    assert abs(float(info.innovation[0]) - 0.01) < 0.003
    np.testing.assert_allclose(info.innovation_cov[0, 0], 2e-4, rtol=0.2)


@pytest.mark.parametrize("name", BUILD)
def test_a_target_that_passes_through_a_bearing_sensor(name):
    """Exactly over it at 2 s, where the bearing is undefined: it counts as 0 for a particle on the
    sensor, and for the others is what they see, so that every measurement is used or rejected with
    a status, numbers stay finite, and the filter has the target afterwards."""
    model = constant_velocity(sensors=bearing_sensor(0.05**2), q=lambda p: p["q"], dims=2)
    method = BUILD[name](model, 2000)
    prior = ej.Gaussian(np.array([-2.0, 0.0, 1.0, 0.0]), np.diag([0.04, 0.04, 0.01, 0.01]))
    at = np.array([0.5, 1.0, 1.5, 2.0, 2.5, 2.25, 3.0, 3.5, 4.0])

    def ran(q, prior, seen):
        return ej.run(method, {"q": q}, ej.stream(at, seen), prior=prior, t0=0.0, key=KEY)

    trace = ran(1e-3, prior, np.arctan2(0.0, at - 2.0))
    assert all(np.isfinite(x).all() for x in (trace.mean, trace.cov, *trace.info))
    assert np.isin(trace.info.status, [Status.USED, Status.LATE_USED, *REFUSED]).all()
    assert trace.info.status[-1] == Status.USED
    error = trace.mean[-1] - np.array([2.0, 0.0, 1.0, 0.0])
    assert np.abs(error / np.sqrt(np.diagonal(trace.cov[-1]))).max() < 4
    on_it = ran(0.0, ej.Gaussian(np.zeros(4), np.zeros((4, 4))), np.full(at.shape, 0.01))
    assert on_it.info.status[0] == Status.USED
    np.testing.assert_allclose(on_it.info.innovation[0], 0.01)
    np.testing.assert_array_equal(on_it.mean[0], 0)


@pytest.mark.parametrize("name", ["retrodict", "extended", "eks", "ps"])
def test_a_late_measurement_that_leaves_too_few_particles_is_rejected(name):
    """A precise value far out, with the factor 100, and used where the factor is switched off."""
    count = 1000
    settings = {} if name in ("retrodict", "extended") else {"smoother": name}
    lag = () if name == "retrodict" else (3,)
    build = {"retrodict": pf_retrodict, "extended": pf_extended}.get(name, pf_fixed_point)
    for collapse, expected in ((100.0, Status.REJECTED), (None, Status.LATE_USED)):
        method = build(LINE, count, *lag, **settings, collapse=collapse)
        step = jax.jit(lambda state, z, method=method: ej.step(method, PARAMS, state, z))
        state = method.init(PARAMS, PRIOR, 0.0, KEY)
        for time, value in ((1.0, 11.0), (2.0, 12.0)):
            state, _ = step(state, measured(time, value))
        after, info = step(state, measured(1.5, 30.0))
        assert info.status == expected
        same = np.array_equal(after.log_weights, state.log_weights)
        assert same == (expected == Status.REJECTED)
        assert np.isfinite(method.estimate(PARAMS, after).mean).all()


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: bootstrap(LINE, 1), "particles: expected a whole number >= 2, got 1"),
        (lambda: bootstrap(LINE, 9.5), "particles: expected a whole number >= 2"),
        (lambda: bootstrap(LINE, 9, "multinomial"), "resampling: expected 'systematic' or"),
        (lambda: bootstrap(LINE, 9, ess_threshold=-1.0), "ess_threshold: expected a number >= 0"),
        (lambda: bootstrap(None, 9), "model: expected a Model, got NoneType"),
        (lambda: pf_extended(LINE, 9, 0), "lag: expected a whole number >= 1, got 0"),
        (lambda: pf_retrodict(LINE, 9, collapse=0.5), "collapse: expected a number >= 1"),
        (lambda: pf_fixed_point(LINE, 9, 3, "rts"), "smoother: expected 'eks', 'uks' or 'ps'"),
        (lambda: pf_fixed_point(LINE, 9, 3, "ps", 1), "smoother_particles: expected a whole"),
    ],
)
def test_settings_that_make_no_sense_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_sigma_points_that_float32_cannot_tell_apart_are_refused():
    method = pf_fixed_point(LINE, 9, 3, "uks", ut_alpha=1e-3)
    single = ej.Gaussian(*(np.asarray(x, np.float32) for x in PRIOR))
    method.init(PARAMS, PRIOR, 0.0, KEY)
    with pytest.raises(ValueError, match="ut_alpha: expected"):
        method.init(PARAMS, single, 0.0, KEY)
