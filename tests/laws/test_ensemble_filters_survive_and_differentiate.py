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
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.asd import asd
from ewif_jax.oosm.enkf1 import enkf1
from ewif_jax.oosm.enkf2 import enkf2
from ewif_jax.oosm.rts_reference import rts_reference


def world():
    """Position along x and the bearing from the origin, in the plane; at one time, nothing."""
    base = constant_velocity(sensors=bearing_sensor(1.0), dims=2, q=lambda p: p["q"])

    def observe(params, x, sensor, t):
        seen = jnp.concatenate([x[:1], base.observe(params, x, sensor, t)])
        return jnp.where(t == params["blind"], jnp.nan, seen)

    def measurement_cov(params, sensor, t):
        return params["r"] * jnp.diag(jnp.array([1.0, 0.05]))

    def residual(value, predicted, sensor):
        difference = value - predicted
        return jnp.stack([difference[0], wrap_angle(difference[1])])

    return base._replace(observe=observe, measurement_cov=measurement_cov, residual=residual)


MODEL = world()
FILTERS = {
    "extended": ej.extended(MODEL),
    "unscented": unscented(MODEL, ut_beta=2.0),
    "al1": al1(MODEL, 3),
    "asd": asd(MODEL, 3),
    "rts_reference": rts_reference(MODEL, 3),
    "two_members": ensemble(MODEL, 2),
    "fewer_members_than_states": ensemble(MODEL, 3, "square_root"),
    "enkf1": enkf1(MODEL, 2, 3),
    "enkf2": enkf2(MODEL, 3, 3),
    "enkf2_shared": enkf2(MODEL, 3, 3, "shared"),
}
IN_SEQUENCE_ONLY = ("extended", "unscented", "two_members", "fewer_members_than_states")
each = pytest.mark.parametrize(
    "name", [pytest.param(x, marks=pytest.mark.slow if x == "enkf2" else ()) for x in FILTERS]
)
PARAMS = {"q": 0.3, "r": 0.1, "blind": -1.0}
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

    compiled = jax.jit(jax.value_and_grad(loss, has_aux=True))
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


def bad(value):
    """In sequence and late, while the filter stands at one time."""
    return STREAM._replace(value=STREAM.value.at[3:5, 0].set(value))


NOT_NUMBERS = {
    "NaN": (PARAMS, bad(np.nan), (3, 4)),
    "infinite": (PARAMS, bad(np.inf), (3, 4)),
    "square overflows": (PARAMS, bad(-1e200), (3, 4)),
    "unseen in sequence": ({**PARAMS, "blind": 0.9}, STREAM, (4,)),
    "unseen late": ({**PARAMS, "blind": 1.0}, STREAM, (6,)),
    "unseen at a new time": ({**PARAMS, "blind": 1.4}, STREAM, (5,)),
}


@each
@pytest.mark.parametrize("case", NOT_NUMBERS)
def test_what_is_not_a_number_is_rejected_within_a_run(name, case):
    """Gradients stay finite, and what comes after is used as ever."""
    params, data, where = NOT_NUMBERS[case]
    (_, (mean, cov, info)), slope = both(name)(params, PRIOR, data)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((mean, cov, info, slope)))
    late = info.delay > 0
    expected = np.where(late, ej.Status.LATE_USED, ej.Status.USED)
    expected[list(where)] = ej.Status.REJECTED
    if case == "unseen in sequence":
        expected[2] = ej.Status.REJECTED
    if name in IN_SEQUENCE_ONLY:
        # What is no number is refused unseen; what the model makes none of is too late to be seen.
        refused = expected == ej.Status.REJECTED if not case.startswith("unseen") else False
        expected[late & ~np.asarray(refused)] = ej.Status.TOO_LATE
    np.testing.assert_array_equal(info.status, expected)
    np.testing.assert_array_equal(info.log_likelihood != 0, expected < ej.Status.TOO_LATE)
    for k in where:
        if data.time[k] <= data.time[:k].max():
            np.testing.assert_allclose(mean[k], mean[k - 1], rtol=1e-13)
            np.testing.assert_allclose(cov[k], cov[k - 1], rtol=1e-13)
        else:
            at, velocity = mean[k - 1][:2], mean[k - 1][2:]
            predicted = [*(at + velocity * (STREAM.time[k] - STREAM.time[k - 1])), *velocity]
            np.testing.assert_allclose(mean[k], predicted, rtol=1e-12)


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
