"""Theorems 1 and 2 of Shulami & Sigalov, against a dense solution that shares no code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import wls

import ewif_jax as ej
from ewif_jax.smoothers.batch_wls import batch_wls
from laws.cases import case, close, model

REPORTS = np.array([5.0, -1.0, 2.0, 3.3])


def window(p, measured, at):
    return jnp.where(jnp.abs(at - measured) <= 1.5, 1.0, 0.0)


def one_sided(p, measured, at):
    return jnp.exp(-(at - measured) / (2 * p["tau"]))


def two_sided(p, measured, at):
    return jnp.exp(-jnp.abs(at - measured) / (2 * p["tau"]))


WEIGHTS = {
    "ewif": (wls.ewif_weight, one_sided),
    "symmetric": (wls.symmetric_weight, two_sided),
    "window": (lambda tau: wls.window_weight(1.5), window),
}


@pytest.mark.parametrize("with_prior", [False, True])
@pytest.mark.parametrize("name", WEIGHTS)
def test_estimate_and_covariance_agree(name, with_prior):
    world = case(1, 3)
    plain, weight = WEIGHTS[name]
    prior = world.prior if with_prior else None
    ours = batch_wls(
        model(), world.params, world.stream(), REPORTS, weight=weight, prior=prior, t0=0.5
    )
    known = None if prior is None else (prior.mean, prior.cov, 0.5)
    undetermined = 0
    for k, t in enumerate(REPORTS):
        try:
            mean, cov = wls.batch_wls(
                t, **world.back(), **world.data(), weight=plain(world.params["tau"]), prior=known
            )
        except np.linalg.LinAlgError:
            undetermined += 1
            assert np.all(np.isnan(ours.mean[k]))
            assert np.all(np.isnan(ours.cov[k]))
            continue
        close(ours.mean[k], mean)
        close(ours.cov[k], cov)
    assert undetermined == (2 if name == "window" and prior is None else name == "window")


def test_gradients_are_finite_where_nothing_is_determined():
    world = case(1, 3)
    few = jax.tree.map(lambda x: x[:2], world.stream())
    few = few._replace(mask=few.mask.at[1].set(False))

    def loss(params):
        return jnp.nansum(batch_wls(model(), params, few, REPORTS, weight=one_sided).mean)

    slopes = jax.jit(jax.grad(loss))(jax.tree.map(jnp.asarray, world.params))
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slopes))


def test_float32_is_close():
    world = case(1, 3)
    single = world.stream()._replace(value=world.stream().value.astype(jnp.float32))
    low = batch_wls(model(), world.params, single, REPORTS[2:], weight=two_sided)
    high = batch_wls(model(), world.params, world.stream(), REPORTS[2:], weight=two_sided)
    assert low.mean.dtype == low.cov.dtype == jnp.float32
    close(low.mean, high.mean, rtol=1e-5)
    close(low.cov, high.cov, rtol=1e-5)


@pytest.mark.parametrize(
    ("times", "changes", "word"),
    [
        (1.0, {}, "times"),
        (REPORTS, {"weight": 2.0}, "weight"),
        (REPORTS, {"prior": ej.Gaussian(np.zeros(3), np.eye(3))}, "t0"),
    ],
)
def test_bad_input_is_named(times, changes, word):
    world = case(1, 3)
    with pytest.raises(ValueError, match=word):
        batch_wls(model(), world.params, world.stream(), times, **{"weight": window} | changes)
