"""Smooth maps between free numbers, which an optimizer moves, and constrained parameters."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.recipe import FromRecipe, from_recipe


class _TransformFields(NamedTuple):
    constrain: Callable[[Array], Array]
    free: Callable[[Array], Array]


class Transform(FromRecipe, _TransformFields):
    """A smooth map from free numbers to a constrained parameter, and its inverse."""


@from_recipe
def unconstrained() -> Transform:
    """Any real numbers."""
    return Transform(_identity_map, _identity_map)


@from_recipe
def positive() -> Transform:
    """Positive numbers through their logarithm: steps are relative, as suits tau, q and r."""
    return Transform(_exponential_map, _logarithm_map)


@from_recipe
def negative() -> Transform:
    """Negative numbers through the logarithm of their size."""
    return Transform(_minus_exponential, _logarithm_of_size)


@from_recipe
def bounded(low: float, high: float) -> Transform:
    r"""Numbers between `low` and `high`, through the logistic function.

    .. math::
        x = l + (h - l) / (1 + e^{-y}), \quad y = \log (x - l) - \log (h - x)

    Args:
        low, high: finite numbers, low < high; what lies on or beyond them cannot be held.

    Raises:
        ValueError: low >= high, or one that is not a finite number.
    """
    checks.finite("low", low)
    checks.finite("high", high)
    checks.require(low < high, "high", f"a number above low = {low}", high)
    interval = float(low), float(high)
    return Transform(_ToInterval(*interval), _FromInterval(*interval))


@from_recipe
def psd() -> Transform:
    """Positive definite matrices through their Cholesky factor with a log diagonal."""
    return Transform(_from_root, _to_root)


# Named functions and tuples, not lambdas: equal transforms compare equal, and go through pickle.


class _ToInterval(NamedTuple):
    low: float
    high: float

    def __call__(self, free: Array) -> Array:
        return self.low + (self.high - self.low) * jax.nn.sigmoid(free)


class _FromInterval(NamedTuple):
    low: float
    high: float

    def __call__(self, inside: Array) -> Array:
        return jnp.log(inside - self.low) - jnp.log(self.high - inside)


def _identity_map(x: Array) -> Array:
    return x


def _exponential_map(x: Array) -> Array:
    return jnp.exp(x)


def _logarithm_map(x: Array) -> Array:
    return jnp.log(x)


def _minus_exponential(x: Array) -> Array:
    return -jnp.exp(x)


def _logarithm_of_size(x: Array) -> Array:
    return jnp.log(-x)


def _from_root(raw: Array) -> Array:
    root = jnp.tril(raw, -1) + jnp.diag(jnp.exp(jnp.diag(raw)))
    return root @ root.T


def _to_root(matrix: Array) -> Array:
    root = jnp.linalg.cholesky(matrix)
    return jnp.tril(root, -1) + jnp.diag(jnp.log(jnp.diag(root)))
