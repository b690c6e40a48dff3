"""Looking both ways in time beats a fixed lag, which beats the filter, each at its best tau."""

import jax
import numpy as np
import pytest

from ewif_jax.monte_carlo import simulate_batch
from ewif_jax.scenarios import sine, sine_model
from ewif_jax.study.papers.arbitrary_target import study as arbitrary_target
from ewif_jax.study.papers.two_sided import runs as two_sided
from ewif_jax.study.shared.late import paired


@pytest.fixture(scope="module")
def on_the_sine():
    batch = simulate_batch(sine(), jax.random.split(jax.random.key(0), 300))
    return two_sided.compared_means(sine_model(), np.asarray([0.5, 0.8]), batch, steps=5)


@pytest.fixture(scope="module")
def on_the_target():
    return arbitrary_target.smoothed(jax.random.key(1), 20, np.asarray([1.0, 1.4, 2.0]))


@pytest.mark.parametrize("scenario", ["on_the_sine", "on_the_target"])
def test_order_of_the_three_beyond_noise(scenario, request):
    squared = request.getfixturevalue(scenario)
    best = {name: x[np.argmin(x.mean(1))] for name, x in squared.items()}
    for worse, better in (("filter", "fixed lag"), ("fixed lag", "two-sided")):
        gained = paired(best[worse], best[better])
        assert gained.value > 4 * gained.error


def test_at_the_published_tau_on_the_sine(on_the_sine):
    """The filter's 0.30 m; both smoothers below it in (nearly) every run."""
    rmse = {name: np.sqrt(x[0].mean()) for name, x in on_the_sine.items()}
    assert rmse["filter"] == pytest.approx(0.30, abs=0.01)
    assert rmse["two-sided"] < 0.85 * rmse["fixed lag"] < 0.75 * rmse["filter"]
    assert np.mean(on_the_sine["two-sided"][0] < on_the_sine["filter"][0]) > 0.95
