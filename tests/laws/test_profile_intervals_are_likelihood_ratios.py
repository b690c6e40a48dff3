"""Profile intervals of q and r are those of the joint Gaussian, maximised by SciPy; an end that is
never reached is that of the domain."""

import numpy as np
from scipy import optimize

import ewif_jax as ej

T = 40
RNG = np.random.default_rng(4)
TIME = np.arange(1.0, T + 1)
KERNEL = np.minimum(TIME[:, None], TIME)
MODEL = ej.models.random_walk(
    sensors=ej.models.position_sensor(lambda p: p["r"]), q=lambda p: p["q"]
)
SETTING = {"prior": ej.Gaussian(np.zeros(1), 4 * np.eye(1)), "t0": 0.0}


def deviance(x, value):
    """Minus twice the log likelihood at x = (log q, log r), up to a constant."""
    half = np.linalg.cholesky(np.exp(x[0]) * KERNEL + 4.0 + np.exp(x[1]) * np.eye(T))
    white = np.linalg.solve(half, value)
    return white @ white + 2 * np.log(np.diagonal(half)).sum()


def test_they_are_the_likelihood_ratios_and_may_end_at_zero():
    walk = np.cumsum(0.7 * RNG.normal(size=T))
    for number, (path, reaches_zero) in enumerate(((walk, False), (0 * walk, True))):
        value = path + RNG.normal(size=T)
        best = optimize.minimize(deviance, [-2.0, 0.0], (value,), method="Nelder-Mead",
                                 options={"xatol": 1e-7, "fatol": 1e-10})  # fmt: skip
        params = dict(zip("qr", np.exp(best.x), strict=True))
        found = ej.profile_intervals(ej.kalman(MODEL), params, ej.stream(TIME, value), **SETTING)

        def profile(r, value=value):
            return optimize.minimize_scalar(
                lambda q: deviance([q, r], value), bounds=(-25, 5), method="bounded"
            ).fun  # fmt: skip

        low, high = np.log(float(found.low["r"])), np.log(float(found.high["r"]))
        for end in (low, high):
            np.testing.assert_allclose(profile(end) - best.fun, 3.841459, rtol=2e-3)
        assert low < best.x[1] < high
        assert (float(found.low["q"]) == 0) == reaches_zero, number
