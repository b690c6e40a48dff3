"""One pass forward and one backward give the symmetric weight, which no recursion (11c) does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import wls

from ewif_jax.smoothers.batch_wls import batch_wls
from ewif_jax.smoothers.two_sided_ewif import two_sided_ewif
from laws.cases import STEPS, case, close, model

REPORTS = np.array([-1.0, 6.0, 2.2])


def tau(params):
    return params["tau"]


def both_sides(params, measured, at):
    return jnp.exp(-jnp.abs(at - measured) / (2 * params["tau"]))


@pytest.mark.parametrize("with_prior", [False, True])
def test_equals_dense_least_squares(with_prior):
    world = case(2, 2)
    prior = {"prior": world.prior, "t0": 1.7} if with_prior else {}
    known = (world.prior.mean, world.prior.cov, 1.7) if with_prior else None
    weight = wls.symmetric_weight(world.params["tau"])
    order = np.random.default_rng(3).permutation(STEPS)
    for times in (None, REPORTS):
        ours = two_sided_ewif(
            model(), world.params, world.stream(order), tau=tau, times=times, **prior
        )
        for k, t in enumerate(world.times[order] if times is None else times):
            mean, cov = wls.batch_wls(t, **world.back(), **world.data(), weight=weight, prior=known)
            close(ours.mean[k], mean)
            close(ours.cov[k], cov)


def test_derivative_equals_that_of_batch_wls():
    world = case(2, 2)
    data = world.stream()

    def passes(decay):
        params = {**world.params, "tau": decay}
        return two_sided_ewif(model(), params, data, tau=tau, times=REPORTS).mean

    def dense(decay):
        params = {**world.params, "tau": decay}
        return batch_wls(model(), params, data, REPORTS, weight=both_sides).mean

    close(jax.jit(jax.jacrev(passes))(0.9), jax.jit(jax.jacfwd(dense))(0.9), rtol=1e-8)


def test_padding_changes_nothing():
    world = case(2, 2)
    plain = two_sided_ewif(model(), world.params, world.stream(), tau=tau, times=REPORTS)
    padding = jax.tree.map(lambda x: x[:3], world.stream())
    padding = padding._replace(mask=padding.mask & False, time=jnp.array([-3.0, 2.1, 9.0]))
    padded = jax.tree.map(lambda *x: jnp.concatenate(x), world.stream(), padding)
    ours = two_sided_ewif(model(), world.params, padded, tau=tau, times=REPORTS)
    close(ours.mean, plain.mean, rtol=1e-10)
    close(ours.cov, plain.cov, rtol=1e-10)


def test_unknown_state_is_nan():
    world = case(2, 2)
    one = jax.tree.map(lambda x: x[:1], world.stream())
    one = one._replace(mask=np.array([[True, False]]))  # one number for two states
    assert np.all(np.isnan(two_sided_ewif(model(), world.params, one, tau=tau).mean))


def test_float32_is_close():
    world = case(2, 2)
    single = world.stream()._replace(value=world.stream().value.astype(jnp.float32))
    low = two_sided_ewif(model(), world.params, single, tau=tau, times=REPORTS)
    high = two_sided_ewif(model(), world.params, world.stream(), tau=tau, times=REPORTS)
    assert low.mean.dtype == low.cov.dtype == jnp.float32
    close(low.mean, high.mean, rtol=1e-4)


def test_bad_input_is_named():
    world = case(2, 2)
    with pytest.raises(ValueError, match="tau"):
        two_sided_ewif(model(), world.params, world.stream(), tau=0.0)
    with pytest.raises(ValueError, match="t0"):
        two_sided_ewif(model(), world.params, world.stream(), tau=1.0, prior=world.prior)
