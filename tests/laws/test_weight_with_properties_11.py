"""Any weight with (11a)-(11c) will do: W(t, t) = 1 and W(l, k) = W(l, m) W(m, k).

W = exp(g(t_l) - g(t_k)) for any g has them; g = t / 2 tau is the EWIF, g = 0 plain least squares.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from oracles.wls import batch_wls

import ewif_jax as ej
from laws.cases import STEPS, case, close, model

GROWTH = {
    "W = 1": lambda xp, t: 0.0 * t,
    "exponential": lambda xp, t: t / 2.6,
    "not exponential": lambda xp, t: 0.4 * xp.log1p(t) + 0.3 * xp.sin(t),
}


@pytest.mark.parametrize("name", GROWTH)
def test_recursion_is_the_batch(name):
    g = GROWTH[name]
    world = case(9, 3)
    filt = ej.ewif(model(), weight=lambda p, t_l, t_k: jnp.exp(g(jnp, t_l) - g(jnp, t_k)))
    order = np.array([0, 1, 2, 9, 3, 8, 4, 7, 5, 6])
    times = np.linspace(2.0, 5.0, STEPS)
    trace = ej.run(filt, world.params, world.stream(order), prior=world.prior, t0=0.0, times=times)
    for k in (3, 6, STEPS - 1):
        mean, cov = batch_wls(
            times[k],
            **world.back(),
            **world.data(order[: k + 1]),
            weight=lambda t_l, t_k: np.exp(g(np, t_l) - g(np, t_k)),
            prior=(world.prior.mean, world.prior.cov, 0.0),
        )
        close(trace.mean[k], mean)
        close(trace.cov[k], cov)


def test_tau_is_the_weight_w_and_not_its_square():
    world = case(9, 3)
    options = {"prior": None, "t0": 0.0}
    by_tau = ej.run(ej.ewif(model(), 1.3), world.params, world.stream(), **options)
    weight = ej.ewif(model(), weight=lambda p, t_l, t_k: jnp.exp((t_l - t_k) / 2.6))
    by_weight = ej.run(weight, world.params, world.stream(), **options)
    close(by_weight.mean[3:], by_tau.mean[3:])
    close(by_weight.cov[3:], by_tau.cov[3:])
