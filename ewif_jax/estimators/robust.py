"""Weighing a measurement by how far it is from what is expected, so that no outlier moves much."""

from typing import Any, Literal

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels import gaussian
from ewif_jax.models import resolve
from ewif_jax.models.linearise import noise_at
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.noisier import (
    Noisy,
    keeps_measurements,
    noisier,
    rebuilt,
    wraps_others,
)
from ewif_jax.types import (
    Estimator,
    Gaussian,
    Info,
    Measurement,
    Numbers,
    Parameter,
    Params,
    RandomKey,
    State,
)

Kind = Literal["weight", "huber", "student"]
KINDS = ("weight", "huber", "student")


@from_recipe
def robust(estimator: Estimator, c: Parameter, kind: Kind = "weight") -> Estimator:
    r"""The estimator that uses a measurement with the noise covariance :math:`R / w^2`.

    With the innovation :math:`\nu` and :math:`u^2 = \nu' R^{-1} \nu` over the m components that are
    present,

    .. math::
        \text{weight:}\quad w^2 &= (1 + u^2 / c^2)^{-1} \\
        \text{huber:}\quad w^2 &= \min(1, c / u) \\
        \text{student:}\quad w^2 &= (c + m) / (c + u^2)

    "weight" is the inverse multi-quadratic of Duran-Martin et al. (2024, arXiv 2405.05646), whose
    generalised posterior is :math:`p(z | x)^{w^2} p(x)`; "huber" one step of Huber's M-estimator;
    "student" one step of expectation maximisation for noise of Student's t with c degrees of
    freedom. Nothing is refused, and everything is differentiable, in c too.

    **Bound.** A linear update moves the mean by
    :math:`P H' R^{-1/2} (R^{-1/2} H P H' R^{-1/2} + I / w^2)^{-1} u`, so by no more than

    .. math::
        \|P H' R^{-1/2}\|_2 \; \sup_u w^2 u, \qquad
        \sup_u w^2 u = \tfrac{c}{2}, \quad c, \quad \tfrac{c + m}{2 \sqrt c}

    for the three kinds, however large the outlier. For "weight" and "student" it even goes to 0
    as the outlier grows, like :math:`1 / u`: a filter that is wrong is then contradicted in vain.
    Where the target may jump, take "huber", or a gate that opens (`gated`).

    Args:
        estimator: made of a `Model`, or a wrapper of such: `robust(replay(e), c)` is
            `replay(robust(e), c)`, and so for every wrapper. The noise is scaled inside of the
            method, so this is exact for each: the information of a measurement of `ewif`, the
            gains that `asd` keeps, the perturbations of an ensemble, the densities of particles,
            late measurements.
        c: > 0, a number or a function of `params`: standard deviations of the noise, beyond which
            a measurement counts as doubtful (2 to 5); for "student" degrees of freedom.
        kind: which of the three.

    `Info` has the plain innovation and its covariance, with R, and status `USED`. Its log
    likelihood is that of the measurement as it is used, :math:`\log N(\nu; 0, H P H' + R / w^2)`:
    not normalised as a density of the measurement, but one that no outlier makes larger than a
    multiple of :math:`\log u`, so a tuning by likelihood survives them. Components without noise
    (a singular R) count nothing in u, and their noise stays 0.

    Reduces to: the estimator itself as c tends to infinity.

    Deviations: the paper divides by R as known; where nothing is known yet (`prior=None`) w = 1.

    Raises:
        ValueError: c <= 0; an unknown kind; an estimator that is not made of a Model; at `init`,
            one that keeps measurements and uses them anew (`limited_memory`, `pf_fixed_point`).
    """
    checks.estimator(estimator)
    checks.require(kind in KINDS, "kind", f"one of {', '.join(KINDS)}", repr(kind))
    if not callable(c):
        checks.positive_number("c", c)
    if wraps_others(estimator):

        def changed(x: Any) -> Any:
            if isinstance(x, Estimator):
                return robust(x, c, kind)
            is_list = type(x) is tuple and any(isinstance(e, Estimator) for e in x)
            return tuple(map(changed, x)) if is_list else x

        return rebuilt(estimator, changed)
    model = estimator.model
    built = estimator.recipe is not None and model is not None
    shown = checks.Shown(estimator)
    checks.require(built, "estimator", "one that a builder made of a Model", shown)
    assert model is not None
    inside = noisier(estimator)

    def init(params: Params, prior: Gaussian | None, t0: Numbers, key: RandomKey = None) -> Any:
        checks.positive_number("c", resolve(c, params))
        state = estimator.init(params, prior, t0, key)
        checks.require(
            not keeps_measurements(state),
            "estimator",
            "one that does not use anew the measurements that it keeps",
            shown,
        )
        return state

    def update(params: Params, state: State, measurement: Measurement) -> tuple[Any, Info]:
        _, info = estimator.update(params, state, measurement)
        # Of stamps that are uncertain the noise depends on the state: here on that of now, since a
        # filter need not be able to go back to the time of what is late.
        x = state.time[None] if model.jitter is None else estimator.estimate(params, state).mean
        R = noise_at(model, params, x, measurement.sensor, measurement.time)
        scale = jnp.asarray(checks.positive_number("c", resolve(c, params)), R.dtype).reshape(())
        factor = _noise_factor(kind, scale, info.innovation, R, measurement.mask)
        updated, used = inside.update(Noisy(params, factor), state, measurement)
        return updated, info._replace(log_likelihood=used.log_likelihood)

    return Estimator(init, estimator.predict, update, estimator.estimate, model=model)


def _noise_factor(kind: str, c: Array, innovation: Array, R: Array, mask: Array) -> Array:
    """1 / w^2 (), 1 where nothing is expected yet."""
    square = gaussian.squared_distance(innovation, gaussian.mask_cov(R, mask))
    is_known = ~jnp.isnan(square)
    square = jnp.where(is_known, square, 0)
    if kind == "weight":
        factor = 1 + square / jnp.square(c)
    elif kind == "huber":
        is_far = square > jnp.square(c)
        factor = jnp.where(is_far, jnp.sqrt(jnp.where(is_far, square, 1)) / c, 1)
    else:
        count = jnp.sum(mask).astype(c.dtype)
        factor = 1 + (square - count) / (c + count)
    # Up to where R times it may overflow: the bound holds for any innovation whose square is a
    # number.
    factor = jnp.minimum(factor, jnp.sqrt(jnp.finfo(c.dtype).max))
    return jnp.where(is_known, factor, 1)
