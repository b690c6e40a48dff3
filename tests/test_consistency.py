"""`nees`, `nis` and `chi2_band` against NumPy and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import ewif_jax as ej


def spd(rng, *lead):
    root = rng.normal(size=(*lead, 3, 3))
    return root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(3)


@pytest.mark.parametrize("known", [1, 2, 3])
def test_nees_is_the_quadratic_form_of_what_is_known_of_the_truth(known):
    rng = np.random.default_rng(0)
    mean, cov, truth = rng.normal(size=(4, 5, 3)), spd(rng, 4, 5), rng.normal(size=(4, 5, known))
    error, part = mean[..., :known] - truth, cov[..., :known, :known]
    expected = np.einsum("...i,...ij,...j->...", error, np.linalg.inv(part), error)
    np.testing.assert_allclose(ej.nees(mean, cov, truth), expected, rtol=1e-10)
    np.testing.assert_allclose(ej.nees(mean[0, 0], cov[0, 0], truth[0, 0]), expected[0, 0])


def test_where_nothing_is_known_nees_is_nan_and_gradients_of_the_rest_are_finite():
    mean = jnp.array([[1.0, 2.0], [jnp.nan, 0.0]])
    cov = jnp.stack([jnp.eye(2), jnp.eye(2)])
    found = ej.nees(mean, cov, jnp.zeros((2, 2)))
    np.testing.assert_array_equal(found, [5.0, jnp.nan])
    slope = jax.grad(lambda x: jnp.nansum(ej.nees(x, cov, jnp.zeros((2, 2)))))(mean)
    np.testing.assert_allclose(slope[0], [2.0, 4.0])
    assert np.isfinite(slope).all()


def test_nis_is_the_quadratic_form_of_the_innovations_that_are_present():
    rng = np.random.default_rng(1)
    H, R, P = rng.normal(size=(2, 3)), np.diag([0.3, 0.7]), spd(rng)
    model = ej.linear_model(np.eye(3), H, R, np.zeros((3, 3)))
    masks = [[True, True], [True, False], [False, True], [False, False]]
    value, mean = rng.normal(size=2), rng.normal(size=3)
    for mask in np.array(masks):
        data = ej.stream([1.0], value[None], mask=mask[None])
        trace = ej.run(ej.kalman(model), None, data, prior=ej.Gaussian(mean, P), t0=1.0)
        error, S = (value - H @ mean)[mask], (H @ P @ H.T + R)[np.ix_(mask, mask)]
        expected = error @ np.linalg.solve(S, error)
        np.testing.assert_allclose(ej.nis(trace.info), [expected], rtol=1e-9)


@pytest.mark.parametrize(("dof", "samples"), [(1, 1), (2, 30), (3, 600), (5, 100_000)])
@pytest.mark.parametrize("level", [0.5, 0.95, 0.999])
def test_the_band_is_that_of_scipy(dof, samples, level):
    tails = np.array([(1 - level) / 2, (1 + level) / 2])
    expected = stats.chi2.ppf(tails, dof * samples) / samples
    np.testing.assert_allclose(ej.analysis.chi2_band(dof, samples, level), expected, rtol=1e-6)


def test_the_band_holds_what_it_should():
    rng = np.random.default_rng(2)
    means = rng.chisquare(2, (4000, 25)).mean(1)
    low, high = ej.analysis.chi2_band(2, 25, 0.9)
    share = ((means > low) & (means < high)).mean()
    assert abs(share - 0.9) < 4 * np.sqrt(0.09 / 4000)


@pytest.mark.parametrize(
    ("given", "name"), [((0, 5), "dof"), ((2, 0), "samples"), ((2, 5, 1.0), "level")]
)
def test_what_is_refused(given, name):
    with pytest.raises(ValueError, match=f"{name}: expected"):
        ej.analysis.chi2_band(*given)
