"""`where=`, `warm_up=` and `ahead=` of every loss, and the losses of forecasts, against a Kalman
filter in NumPy, SciPy's distributions, and exact limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

import ewif_jax as ej
from ewif_jax.kernels.forecasts import gaussian_crps, gaussian_energy, mean_length

T = 30
RNG = np.random.default_rng(6)
TIME = np.cumsum(RNG.uniform(0.5, 1.5, T))
WALK = np.cumsum(RNG.normal(size=(2, T)), -1)
VALUE = WALK.T + RNG.normal(size=(T, 2)) * [0.5, 1.0]
PRESENT = RNG.uniform(size=(T, 2)) > 0.15
PRESENT[[4, 11]] = False
PARAMS = {"q": jnp.asarray(0.9), "r": jnp.asarray(0.4)}
PRIOR = ej.Gaussian(np.zeros(2), 2 * np.eye(2))
MODEL = ej.models.random_walk(
    sensors=ej.models.position_sensor(lambda p: p["r"], dims=2), q=lambda p: p["q"], dims=2
)
KALMAN = ej.kalman(MODEL)
STREAM = ej.Measurement(TIME, np.where(PRESENT, VALUE, 0), np.zeros(T, np.int32), PRESENT)
SETTING = {"prior": PRIOR, "t0": 0.0}
ROWS = RNG.uniform(size=T) > 0.4
COMPONENTS = RNG.uniform(size=(T, 2)) > 0.4
MEASURED = PRESENT.any(-1)
EARLIER = np.cumsum(MEASURED) - MEASURED


def by_hand(ahead=1):
    """Errors and variances (T, 2) of the prediction of each row from those `ahead` rows before."""
    error, variance, estimate = np.zeros((T, 2)), np.ones((T, 2)), np.zeros((T, 2))
    for c in range(2):  # the components are independent
        mean, cov, time = 0.0, 2.0, 0.0
        seen = [(mean, cov, time)]  # after each measured row
        for k in np.flatnonzero(MEASURED):
            m, p, t = seen[max(len(seen) - ahead, 0)]
            error[k, c], variance[k, c] = VALUE[k, c] - m, p + 0.9 * (TIME[k] - t) + 0.4
            cov, time = cov + 0.9 * (TIME[k] - time), TIME[k]
            if PRESENT[k, c]:
                gain = cov / (cov + 0.4)
                mean, cov = mean + gain * (VALUE[k, c] - mean), (1 - gain) * cov
            seen.append((mean, cov, time))
        after = iter(seen[1:])
        now = seen[0]
        for k in range(T):
            now = next(after) if MEASURED[k] else now
            estimate[k, c] = now[0]
    return error, variance, estimate


def wanted(counts, ahead=1):
    """Every loss over the components (T, 2) that count."""
    error, variance, _ = by_hand(ahead)
    counts = counts & PRESENT
    rows = counts.any(-1)
    square = np.where(counts, error**2, 0).sum(-1)[rows]
    spread = np.sqrt(variance)
    density = np.where(counts, -stats.norm.logpdf(error, 0, spread), 0).sum(-1)[rows]
    z = error / spread
    crps = spread * (z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - np.pi**-0.5)
    nis = np.where(counts, z**2, 0).sum(-1)[rows]
    number = counts.sum(-1)[rows]
    shape = stats.cramervonmises(stats.chi2.cdf(nis, number), "uniform").statistic / rows.sum()
    return {
        "prediction": np.sqrt(square.mean()),
        "robust": np.sqrt(square).mean(),
        "likelihood": density.mean(),
        "crps": np.where(counts, crps, 0).sum(-1)[rows].mean(),
        "nis": np.log((nis / number).mean()) ** 2,
        "shape": shape,
    }


LOSSES = {
    "prediction": ej.prediction_loss,
    "robust": lambda *args, **how: ej.prediction_loss(*args, robust=True, **how),
    "likelihood": ej.likelihood_loss,
    "crps": ej.losses.crps_loss,
    "nis": ej.nis_loss,
    "shape": ej.losses.nis_shape_loss,
}
ALL = np.ones((T, 2), bool)
CASES = {
    "some components, a warm-up": (
        {"where": COMPONENTS, "warm_up": 5}, COMPONENTS & (EARLIER >= 5)[:, None], 1,
    ),
    "some rows, three ahead": ({"ahead": 3, "where": ROWS}, ALL & ROWS[:, None], 3),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_every_loss_of_predictions_counts_what_it_is_told(name):
    options, counts, ahead = CASES[name]
    every = {k: build(KALMAN, STREAM, **SETTING, **options) for k, build in LOSSES.items()}
    found = jax.jit(lambda p: {k: loss(p) for k, loss in every.items()})(PARAMS)
    expected = wanted(counts, ahead)
    for key, value in expected.items():
        np.testing.assert_allclose(found[key], value, rtol=1e-8, err_msg=key)
    if ahead == 1:
        total = ej.log_likelihood(KALMAN, PARAMS, STREAM, **SETTING, **options)
        rows = (counts & PRESENT).any(-1).sum()
        np.testing.assert_allclose(total, -expected["likelihood"] * rows, rtol=1e-9)


def test_several_horizons_are_their_mean():
    both = ej.losses.crps_loss(KALMAN, STREAM, ahead=(1, 3), **SETTING)
    mean = (wanted(ALL, 1)["crps"] + wanted(ALL, 3)["crps"]) / 2
    np.testing.assert_allclose(both(PARAMS), mean, rtol=1e-8)


def test_an_rmse_counts_rows_and_components_of_the_truth():
    error = by_hand()[2] - WALK.T
    for where, counts in ((ROWS, ALL & ROWS[:, None]), (COMPONENTS, COMPONENTS), (None, ALL)):
        for warm_up in (0, 6):
            kept = counts & (warm_up <= EARLIER)[:, None]
            loss = ej.rmse_loss(KALMAN, STREAM, WALK.T, where=where, warm_up=warm_up, **SETTING)
            square = np.where(kept, error**2, 0).sum(-1)[kept.any(-1)]
            np.testing.assert_allclose(loss(PARAMS), np.sqrt(square.mean()), rtol=1e-9)
    nees = ej.nees_loss(KALMAN, STREAM, WALK.T, where=ROWS, **SETTING)
    assert np.isfinite(nees(PARAMS))


def test_a_score_is_its_integral():
    for error, spread in ((0.7, 1.3), (-4.0, 0.5), (0.0, 1.0)):

        def square(x, e=error, s=spread):
            return (stats.norm.cdf(x, 0, s) - (x >= e)) ** 2

        value = sum(integrate.quad(square, *ends)[0] for ends in ((-30, error), (error, 30)))
        single = gaussian_crps(jnp.asarray(error), jnp.asarray(spread))
        np.testing.assert_allclose(single, value, rtol=1e-7)
        found = gaussian_energy(jnp.asarray([error]), jnp.asarray([[spread**2]]))
        np.testing.assert_allclose(found, value, rtol=1e-7)
    cov = jnp.asarray([[2.0, 0.6], [0.6, 1.0]])
    draws = np.random.default_rng(0).multivariate_normal([1.0, -0.5], cov, 400_000)
    mean = np.linalg.norm(draws, axis=-1).mean()
    np.testing.assert_allclose(mean_length(jnp.asarray([1.0, -0.5]), cov), mean, rtol=3e-3)
    np.testing.assert_allclose(
        mean_length(jnp.zeros(3), 4 * jnp.eye(3)), 2 * np.sqrt(8 / np.pi), rtol=1e-8
    )
    np.testing.assert_allclose(mean_length(jnp.asarray([3.0, 4.0]), jnp.zeros((2, 2))), 5.0, 1e-7)


HARD = {
    "as it is": (STREAM, {}),
    "error exactly 0": (STREAM._replace(value=np.zeros((T, 2))), {}),
    "no noise at all": (STREAM, {"q": 0.0, "r": 1e-9}),
    "everything masked": (STREAM._replace(mask=np.zeros((T, 2), bool)), {}),
}


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_gradients_of_the_losses_of_forecasts_are_finite_and_equal_in_both_modes(dtype):
    def stacked(params, stream):
        builds = (ej.losses.crps_loss, ej.losses.energy_loss, ej.losses.nis_shape_loss)
        return jnp.stack([build(KALMAN, stream, **SETTING)(params) for build in builds])

    @jax.jit
    def both(params, stream):
        return jax.jacfwd(stacked)(params, stream), jax.jacrev(stacked)(params, stream)

    for name, (stream, change) in HARD.items():
        params = {k: dtype(x) for k, x in {**PARAMS, **change}.items()}
        given = stream._replace(
            time=jnp.asarray(stream.time, dtype), value=jnp.asarray(stream.value, dtype),
            mask=jnp.asarray(stream.mask),
        )  # fmt: skip
        forward, reverse = both(params, given)
        for key in params:
            assert np.isfinite(forward[key]).all(), (name, key)
            if dtype == np.float64:
                np.testing.assert_allclose(forward[key], reverse[key], rtol=1e-6, atol=1e-9)
            assert np.isfinite(reverse[key]).all(), (name, key)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"where": np.ones(3, bool)}, "where: expected booleans of shape"),
        ({"warm_up": -1}, "warm_up: expected a whole number >= 0"),
        ({"ahead": 0}, "ahead: expected a whole number >= 1"),
    ],
)
def test_what_does_not_fit_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ej.likelihood_loss(KALMAN, STREAM, **SETTING, **options)(PARAMS)
