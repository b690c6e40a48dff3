"""`drop_late`, `selective` and `replay` do what they say, whatever they wrap, to the last bit or
rounding: also what draws random numbers or keeps a history of its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from late_streams import problem, stream

import ewif_jax as ej

GIVEN = problem(1, 2)
LAG, SIZE = 4, 20
TIMES = np.array([0.5, 1.0, 0.8, 1.5, 1.2, 2.0])
LATE = np.maximum.accumulate(TIMES) > TIMES
DATA = stream(GIVEN, np.random.default_rng(2), TIMES)
SORTED = jax.tree.map(lambda x: x[np.argsort(TIMES)], DATA)
IN_SEQUENCE = DATA._replace(mask=DATA.mask & ~LATE[:, None])
ESTIMATORS = {
    "unscented": lambda: ej.unscented(GIVEN.model),
    "ensemble": lambda: ej.ensemble(GIVEN.model, SIZE),
    "enkf2": lambda: ej.enkf2(GIVEN.model, SIZE, LAG),
    "enkf2, shared": lambda: ej.enkf2(GIVEN.model, SIZE, LAG, "shared"),
    "rts_reference": lambda: ej.rts_reference(GIVEN.model, LAG),
    "pf_extended": lambda: ej.pf_extended(GIVEN.model, SIZE, LAG),
    "pf_fixed_point": lambda: ej.pf_fixed_point(GIVEN.model, SIZE, LAG),
}

EVERY_KIND = ("rts_reference", "enkf2")
"""with a history; with that and random members"""


def go(estimator, data, params=None):
    options = {"prior": GIVEN.prior, "t0": 0.0, "key": jax.random.key(3)}
    return ej.run(estimator, params, data, **options)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in EVERY_KIND else pytest.mark.slow)
        for name in ESTIMATORS
    ],
)
def test_wrapped(name):
    estimator = ESTIMATORS[name]()
    plain, without, in_order = (go(estimator, data) for data in (DATA, IN_SEQUENCE, SORTED))
    gated = ej.selective(estimator, lambda limit: limit)
    dropped, none, every = (
        go(ej.drop_late(estimator), DATA), go(gated, DATA, jnp.asarray(0.0)),
        go(gated, DATA, jnp.asarray(jnp.inf)),
    )  # fmt: skip
    pairs = [(dropped, without), (none, without), (every, plain)]
    for found, expected in pairs:
        np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(found.cov, expected.cov, rtol=1e-12, atol=1e-12)
    too_late = np.where(LATE, ej.Status.TOO_LATE, ej.Status.USED)
    np.testing.assert_array_equal(dropped.info.status, too_late)
    np.testing.assert_array_equal(none.info.status, too_late)
    np.testing.assert_array_equal(every.info.status, plain.info.status)
    replayed = go(ej.replay(estimator, LAG, width=1), DATA)
    np.testing.assert_allclose(replayed.mean[-1], in_order.mean[-1], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(replayed.cov[-1], in_order.cov[-1], rtol=1e-10, atol=1e-10)
    used = np.where(LATE, ej.Status.LATE_USED, ej.Status.USED)
    np.testing.assert_array_equal(replayed.info.status, used)
