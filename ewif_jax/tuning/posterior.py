"""Posterior densities of parameters, as samplers want them: of free numbers."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.charging import Unused
from ewif_jax.losses import log_likelihood
from ewif_jax.transforms import Transform
from ewif_jax.tuning.domain import given_transforms, kept_signs
from ewif_jax.tuning.pricing import as_float, has_ends, transform_name
from ewif_jax.types import Estimator, Gaussian, Measurement, Numbers, Params, PyTree


class Posterior(NamedTuple):
    """log_density: function free -> (), of a pytree like the parameters of any real numbers;
    start: the free numbers of the parameters given; constrain: function free -> parameters."""

    log_density: Callable[[PyTree], Array]
    start: PyTree
    constrain: Callable[[PyTree], Params]


def posterior(
    estimator: Estimator,
    params: Params,
    measurements: Measurement,
    *,
    prior: Gaussian | None,
    t0: Numbers,
    log_prior: Callable[[Params], Array] | None = None,
    transforms: PyTree = None,
    unused: Unused = "charge",
    **setting: Any,
) -> Posterior:
    r"""The posterior density of parameters, for the samplers of BlackJAX and NumPyro.

    .. math::
        \log p(y) = \log p(z \mid x(y)) + \log p(x(y)) + \sum_i \log |dx_i / dy_i|

    with x the parameters and y the free numbers a sampler moves. Up to a constant. For NumPyro,
    ``numpyro.factor("data", ej.log_likelihood(...))`` does as well.

    Args:
        estimator, measurements, prior, t0, unused, setting: as in `log_likelihood`; a batch is
            the sum over its runs.
        params: where a sampler starts.
        log_prior: function params -> (), the log density of the parameters themselves (not of
            their logarithms); default flat.
        transforms: as in `tune`, but each number by itself (no `psd`); default: what refuses the
            flipped sign keeps its sign, anything else is free.

    Raises:
        ValueError: a transform that mixes numbers; what `log_likelihood` refuses.
    """
    params = jax.tree.map(as_float, params)
    leaves, structure = jax.tree.flatten(params)

    def likelihood(own: Params) -> Array:
        return log_likelihood(
            estimator, own, measurements, prior=prior, t0=t0, unused=unused, **setting
        )

    def refuses(own: tuple[Any, ...]) -> bool:
        try:
            jax.eval_shape(lambda: likelihood(jax.tree.unflatten(structure, own)))
        except ValueError:
            return True
        return False

    jax.eval_shape(lambda: likelihood(params))  # what is refused of known numbers is refused now
    found = kept_signs(given_transforms(transforms, params), leaves, refuses)
    for transform in found:
        name = transform_name(transform)
        single = has_ends(transform) or name.startswith("unconstrained")
        checks.require(single, "transforms", "transforms of single numbers", name)

    def constrain(free: PyTree) -> Params:
        pairs = zip(found, jax.tree.leaves(free), strict=True)
        return jax.tree.unflatten(structure, [t.constrain(y) for t, y in pairs])

    def log_density(free: PyTree) -> Array:
        own = constrain(free)
        stretch = [
            jnp.sum(jnp.log(jnp.abs(_transform_slope(t, y))))
            for t, y in zip(found, jax.tree.leaves(free), strict=True)
        ]
        total = likelihood(own) + sum(stretch)
        return total if log_prior is None else total + log_prior(own)

    start = [t.free(x) for t, x in zip(found, leaves, strict=True)]
    return Posterior(log_density, jax.tree.unflatten(structure, start), constrain)


def _transform_slope(transform: Transform, free: Array) -> Array:
    """dx / dy of each number."""
    return jax.jvp(transform.constrain, (free,), (jnp.ones_like(free),))[1]
