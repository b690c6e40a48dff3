"""Standard errors are those of the density of all measurements together, written down in NumPy:
late, missing and irregular rows, several runs, one parameter fixed, derived numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

R, T = 4, 25
RNG = np.random.default_rng(8)
TIME = np.cumsum(RNG.exponential(0.7, T))
ARRIVAL = TIME + np.where(RNG.uniform(size=T) < 0.3, 1.5, 0.0)
ORDER = np.argsort(ARRIVAL, kind="stable")
KERNEL = np.minimum(TIME[:, None], TIME)
PARAMS = {"q": 0.8, "r": 0.5}
VALUE = RNG.multivariate_normal(np.zeros(T), 0.8 * KERNEL + 0.5 * np.eye(T) + 1.0, size=R)
PRESENT = RNG.uniform(size=T) > 0.15
PRIOR = ej.Gaussian(np.zeros(1), np.eye(1))
MODEL = ej.models.random_walk(
    sensors=ej.models.position_sensor(lambda p: p["r"]), q=lambda p: p["q"]
)
ESTIMATOR = ej.asd(MODEL, 12)
SETTING = {"prior": PRIOR, "t0": 0.0}


def stream(dtype=np.float64):
    mask = np.broadcast_to(PRESENT[ORDER, None], (R, T, 1))
    return ej.Measurement(
        TIME[ORDER].astype(dtype), VALUE[:, ORDER, None].astype(dtype), np.zeros(T, np.int32), mask
    )


def by_hand():
    """Scores (R, 2) and the observed information (2, 2) in (q, r)."""
    kept = np.flatnonzero(PRESENT)
    K, eye = KERNEL[np.ix_(kept, kept)], np.eye(len(kept))
    inverse = np.linalg.inv(0.8 * K + 0.5 * eye + 1.0)
    ways = [inverse @ K, inverse]
    z = VALUE[:, kept]
    scores = np.stack(
        [(np.einsum("ri,ij,rj->r", z, D @ inverse, z) - np.trace(D)) / 2 for D in ways], -1
    )
    information = np.array(
        [
            [np.einsum("ri,ij,rj->", z, A @ B @ inverse, z) - R * np.trace(A @ B) / 2 for B in ways]
            for A in ways
        ]
    )
    return scores, (information + information.T) / 2


def wanted(kind):
    scores, information = by_hand()
    inverse = np.linalg.inv(information)
    if kind == "observed":
        return inverse
    return inverse @ (scores.T @ scores * R / (R - 1)) @ inverse


@pytest.mark.parametrize("kind", ["observed", "sandwich"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_covariance_is_that_of_the_joint_gaussian(kind, dtype):
    params = {k: dtype(x) for k, x in PARAMS.items()}
    found = ej.standard_errors(ESTIMATOR, params, stream(dtype), kind=kind, **SETTING)
    tight = {"rtol": 1e-8 if dtype == np.float64 else 1e-2}
    np.testing.assert_allclose(found.cov, wanted(kind), **tight)
    assert found.cov.dtype == dtype
    np.testing.assert_allclose(found.errors["q"], np.sqrt(wanted(kind)[0, 0]), **tight)
    np.testing.assert_allclose(found.errors["r"], np.sqrt(wanted(kind)[1, 1]), **tight)
    slope = by_hand()[0].sum(0)
    away = np.sqrt(slope @ np.linalg.inv(by_hand()[1]) @ slope)
    np.testing.assert_allclose(found.distance, away, **tight)


def test_what_is_fixed_has_no_error_and_derived_numbers_have_the_delta_methods():
    found = ej.standard_errors(ESTIMATOR, PARAMS, stream(), fixed="r", **SETTING)
    np.testing.assert_allclose(found.errors["q"], by_hand()[1][0, 0] ** -0.5, rtol=1e-8)
    assert found.errors["r"] == 0
    free = ej.standard_errors(ESTIMATOR, PARAMS, stream(), **SETTING)
    logs = free.derived(lambda p: jax.tree.map(jnp.log, p))
    np.testing.assert_allclose(logs.errors["r"], free.errors["r"] / 0.5, rtol=1e-10)
    ratio = free.derived(lambda p: p["q"] / p["r"])
    slope = np.array([1 / 0.5, -0.8 / 0.5**2])
    np.testing.assert_allclose(ratio.errors, np.sqrt(slope @ wanted("observed") @ slope), rtol=1e-8)
    low, high = free.interval(0.95)
    np.testing.assert_allclose(high["q"] - low["q"], 2 * 1.959964 * free.errors["q"], rtol=1e-6)


def test_where_there_is_no_maximum_errors_are_no_numbers():
    """Far above the right r the likelihood bends the other way."""
    found = ej.standard_errors(ESTIMATOR, PARAMS | {"r": 1e4}, stream(), fixed="q", **SETTING)
    assert np.isnan(found.errors["r"])
    with pytest.raises(ValueError, match="kind: expected 'observed' or 'sandwich'"):
        ej.standard_errors(ESTIMATOR, PARAMS, stream(), kind="expected", **SETTING)
