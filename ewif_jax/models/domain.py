"""Variances that are none: refused where they are known, else NaN, so that every estimate made from
them is NaN too. A number that is not a variance has the derivative 0."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.dtypes import canonicalize_dtype

from ewif_jax import checks
from ewif_jax.models.parameters import resolve
from ewif_jax.types import Numbers, Params

ROUNDING = 1e-5
"""How far below zero, as a share of the largest variance, rounding may take an eigenvalue."""


def floating(value: Numbers) -> Any:
    """As an array of floats: whole numbers are numbers too. What is known stays NumPy's, with which
    nothing is compiled."""
    concrete = checks.concrete_value(value)
    value = jnp.asarray(value) if concrete is None else concrete
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(float)


def scaled(factor: Numbers, matrix: Array) -> Array:
    """factor () times a matrix, also where types may not be promoted silently."""
    if not hasattr(factor, "dtype"):
        return factor * matrix
    dtype = canonicalize_dtype(jnp.promote_types(factor.dtype, matrix.dtype))
    return factor.astype(dtype) * matrix.astype(dtype)


def variance(argument: str, value: Numbers, params: Params, expected: tuple[int, ...] = ()) -> Any:
    """A variance or density (), or several, read from `params`; NaN if it turns out to be none."""
    found = resolve(value, params)
    check_variance(argument, found, expected)
    if checks.concrete_value(found) is not None:
        return found if np.ndim(found) == 0 and not hasattr(found, "dtype") else floating(found)
    found = floating(found)
    return jnp.where((found >= 0) & (found < jnp.inf), found, jnp.nan)


def check_variance(argument: str, value: Numbers, expected: tuple[int, ...] = ()) -> None:
    """Refuses a known number (or numbers of the shape `expected`) that is no variance."""
    checks.shape(argument, value, expected)
    checks.at_least(argument, value, 0.0)
    checks.finite(argument, value)


def covariance(argument: str, value: Numbers) -> Array:
    """A covariance (m, m); NaN if it turns out to be none, by its variances and correlations."""
    concrete = checks.concrete_value(value)
    if concrete is not None:
        if not np.isnan(concrete).any():  # NaN is the answer where no interval was asked for
            checks.psd(argument, concrete)
        return floating(value)
    value = floating(value)
    variances = jnp.diagonal(value)
    low = ROUNDING * jnp.max(variances)
    spread = jnp.sqrt(jnp.maximum(variances, 0) + low)
    good = jnp.all(variances >= -low) & jnp.all(
        (abs(value) <= (1 + ROUNDING) * spread[:, None] * spread[None, :]) & (abs(value) < jnp.inf)
    )
    return jnp.where(good, value, jnp.nan)


def check_covariances(Q: Callable[..., Any] | None, R: Callable[..., Any] | None) -> Any:
    """A check (params, t0, t1, sensors) that Q(params, t0, t1) and R(params, sensor, t1) of known
    parameters are covariances; of no interval (t0 = t1) Q is not asked."""

    def check(params: Params, t0: Numbers, t1: Numbers, sensors: Numbers) -> None:
        if Q is not None and t1 > t0:
            check_covariance("Q", Q(params, t0, t1))
        if R is not None:
            for sensor in sensors:
                check_covariance("R", R(params, sensor, t1))

    return check


def check_covariance(argument: str, value: Numbers) -> None:
    """Refuses a known matrix that is no covariance, or is not known to be one."""
    checks.psd(argument, value)
