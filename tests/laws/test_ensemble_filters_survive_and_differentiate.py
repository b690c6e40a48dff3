"""Degenerate ensembles and data stay finite; gradients are those of fixed random numbers."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.estimators.ensemble import ensemble
from ewif_jax.estimators.unscented import unscented
from ewif_jax.models import bearing_sensor, constant_velocity
from ewif_jax.models.sensors import wrap_angle
from ewif_jax.oosm.enkf1 import enkf1
from ewif_jax.oosm.enkf2 import enkf2
from ewif_jax.oosm.rts_reference import rts_reference


def world():
    """Position along x and the bearing from the origin, in the plane."""
    base = constant_velocity(sensors=bearing_sensor(1.0), dims=2, q=lambda p: p["q"])

    def observe(params, x, sensor, t):
        return jnp.concatenate([x[:1], base.observe(params, x, sensor, t)])

    def measurement_cov(params, sensor, t):
        return params["r"] * jnp.diag(jnp.array([1.0, 0.05]))

    def residual(value, predicted, sensor):
        difference = value - predicted
        return jnp.stack([difference[0], wrap_angle(difference[1])])

    return base._replace(observe=observe, measurement_cov=measurement_cov, residual=residual)


MODEL = world()
FILTERS = {
    "unscented": unscented(MODEL, ut_beta=2.0),
    "rts_reference": rts_reference(MODEL, 3),
    "two_members": ensemble(MODEL, 2),
    "fewer_members_than_states": ensemble(MODEL, 3, "square_root"),
    "enkf1": enkf1(MODEL, 2, 3),
    "enkf2": enkf2(MODEL, 3, 3),
    "enkf2_shared": enkf2(MODEL, 3, 3, "shared"),
}
each = pytest.mark.parametrize("name", FILTERS)
PARAMS = {"q": 0.3, "r": 0.1}
PRIOR = ej.Gaussian(np.array([-4.0, 0.1, 0.5, -0.2]), np.diag([0.5, 0.5, 0.1, 0.1]))
AT_THE_SENSOR = ej.Gaussian(np.zeros(4), np.zeros((4, 4)))
STREAM = ej.stream(
    [0.2, 0.5, 0.9, 0.7, 0.9, 1.4, 1.0],
    np.stack([np.linspace(-3.9, -3.0, 7), [3.1, -3.1, 3.0, 3.1, -3.0, -3.1, 3.1]], 1),
)
OUTLIER = STREAM._replace(value=STREAM.value.at[2, 0].set(1e6))
MASKED = STREAM._replace(mask=STREAM.mask & False)
PARTLY = STREAM._replace(mask=STREAM.mask.at[1::2, 0].set(False).at[2].set(False))


@cache
def both(name):
    """Everything a run reports, and a loss with its gradient, compiled once for all cases."""

    def loss(params, prior, data):
        trace = ej.run(FILTERS[name], params, data, prior=prior, t0=0.0, key=jax.random.key(4))
        value = jnp.sum(trace.mean**2) + jnp.sum(trace.cov) + jnp.sum(trace.info.log_likelihood)
        return value, (trace.mean, trace.cov, trace.info)

    compiled = jax.jit(
        jax.value_and_grad(loss, has_aux=True),
        compiler_options={"xla_backend_optimization_level": 0},
    )
    return lambda params, prior, data: compiled(params, jax.tree.map(jnp.asarray, prior), data)


CASES = {
    "usual": (PARAMS, PRIOR, STREAM),
    "no process noise": ({**PARAMS, "q": 0.0}, PRIOR, STREAM),
    "target at the sensor": (PARAMS, AT_THE_SENSOR, STREAM),
    "nothing uncertain": ({**PARAMS, "q": 0.0}, AT_THE_SENSOR, STREAM),
    "outlier": (PARAMS, PRIOR, OUTLIER),
    "partly masked": (PARAMS, PRIOR, PARTLY),
    "all masked": (PARAMS, PRIOR, MASKED),
}


@each
@pytest.mark.parametrize("case", CASES)
def test_everything_stays_finite_gradients_too(name, case):
    (_, shown), slope = both(name)(*CASES[case])
    for x in jax.tree.leaves((shown, slope)):
        assert np.isfinite(x).all()
    if case == "all masked":
        assert np.all(shown[2].status == ej.Status.MASKED)


@each
def test_gradients_are_finite_differences(name):
    _, slope = both(name)(PARAMS, PRIOR, PARTLY)
    for key, value in PARAMS.items():
        h = 1e-6
        up, down = (both(name)({**PARAMS, key: value + e}, PRIOR, PARTLY)[0][0] for e in (h, -h))
        np.testing.assert_allclose(slope[key], (up - down) / (2 * h), rtol=2e-5, atol=1e-6)


@each
def test_bearings_across_the_cut_are_seen_right(name):
    """All along, the target is 4 m away on -x: the innovations in bearing stay small."""
    (_, (_, _, info)), _ = both(name)(PARAMS, PRIOR, STREAM)
    assert np.abs(info.innovation[:, 1]).max() < 0.6


def test_single_and_double_precision_see_the_same_noise():
    estimator = enkf2(MODEL, 40, 3, "shared")
    traces = [
        ej.run(
            estimator,
            PARAMS,
            STREAM._replace(value=STREAM.value.astype(dtype)),
            prior=PRIOR,
            t0=0.0,
            key=jax.random.key(0),
        )
        for dtype in (np.float32, np.float64)
    ]
    np.testing.assert_allclose(traces[0].mean, traces[1].mean, atol=2e-4)
    np.testing.assert_allclose(traces[0].cov, traces[1].cov, atol=2e-4)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ensemble(MODEL, 1), "members: expected a whole number >= 2"),
        (lambda: ensemble(MODEL, 9, "etkf"), "form: expected one of"),
        (lambda: enkf1(MODEL, 9, 0), "lag: expected a whole number >= 1"),
        (lambda: enkf2(MODEL, 9, 2, "none"), "noise: expected one of"),
    ],
)
def test_bad_settings_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
