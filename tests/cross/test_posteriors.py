"""The posterior of q and r under late data: its density against a grid, and BlackJAX's draws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

T = 60
RNG = np.random.default_rng(3)
TIME = np.arange(1.0, T + 1)
VALUE = np.cumsum(RNG.normal(size=T)) * 0.7 + RNG.normal(size=T)
ARRIVAL = TIME + np.where(RNG.uniform(size=T) < 0.3, 1.5, 0.0)
STREAM = ej.stream(TIME, VALUE, arrival=ARRIVAL)
MODEL = ej.models.random_walk(
    sensors=ej.models.position_sensor(lambda p: p["r"]), q=lambda p: p["q"]
)
PRIOR = ej.Gaussian(np.zeros(1), 4 * np.eye(1))


def log_prior(p):
    """Log-normal with spread 1 about 1."""
    return sum(-jnp.log(x) - jnp.log(x) ** 2 / 2 for x in (p["q"], p["r"]))


def built():
    return ej.posterior(
        ej.asd(MODEL, 6), {"q": 0.5, "r": 1.0}, STREAM, prior=PRIOR, t0=0.0, log_prior=log_prior
    )


def grid():
    """Log densities of (log q, log r) on a grid, by the joint Gaussian in NumPy."""
    kernel, ends = np.minimum(TIME[:, None], TIME), np.linspace(-4, 3, 57)
    found = np.empty((57, 57))
    for i, q in enumerate(np.exp(ends)):
        for j, r in enumerate(np.exp(ends)):
            cov = q * kernel + 4.0 + r * np.eye(T)
            half = np.linalg.cholesky(cov)
            white = np.linalg.solve(half, VALUE)
            found[i, j] = -(white @ white) / 2 - np.log(np.diagonal(half)).sum()
    found -= T * np.log(2 * np.pi) / 2
    return ends, found - (ends[:, None] ** 2 + ends**2) / 2


def test_the_density_of_the_free_numbers_is_that_of_the_joint_gaussian():
    found = built()
    ends, wanted = grid()
    log_density = jax.jit(found.log_density)
    for i, j in ((20, 30), (35, 28), (10, 50)):
        free = {"q": jnp.asarray(ends[i]), "r": jnp.asarray(ends[j])}
        np.testing.assert_allclose(log_density(free), wanted[i, j], rtol=1e-9)
    np.testing.assert_allclose(found.constrain(found.start)["q"], 0.5, rtol=1e-12)
    with pytest.raises(ValueError, match="transforms: expected transforms of single numbers"):
        ej.posterior(
            ej.asd(MODEL, 6), {"q": 0.5, "r": 1.0}, STREAM, prior=PRIOR, t0=0.0,
            transforms={"q": ej.transforms.psd()},
        )  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_draws_of_blackjax_agree_with_the_grid():
    blackjax = pytest.importorskip("blackjax")
    found = built()
    ends, density = grid()
    weight = np.exp(density - density.max())
    weight /= weight.sum()
    adapt = blackjax.window_adaptation(blackjax.nuts, found.log_density)
    (state, tuned), _ = adapt.run(jax.random.key(0), found.start, 300)
    step = jax.jit(blackjax.nuts(found.log_density, **tuned).step)

    def draw(state, key):
        state, _ = step(key, state)
        return state, state.position

    _, drawn = jax.lax.scan(draw, state, jax.random.split(jax.random.key(1), 1000))
    for name, axis in (("q", 1), ("r", 0)):
        marginal = weight.sum(axis)
        mean = marginal @ ends
        spread = np.sqrt(marginal @ (ends - mean) ** 2)
        # About 300 independent draws of 1,000: four standard errors.
        np.testing.assert_allclose(drawn[name].mean(), mean, atol=4 * spread / np.sqrt(300))
        np.testing.assert_allclose(drawn[name].std(), spread, rtol=4 / np.sqrt(2 * 300))
