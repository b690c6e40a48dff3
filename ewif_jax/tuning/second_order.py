"""Standard errors of parameters, from the second derivatives of the likelihood."""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.scipy.special import ndtri

from ewif_jax import checks, scores
from ewif_jax.charges import density_cost
from ewif_jax.charging import Unused, value_charging
from ewif_jax.fast.layout import Frozen
from ewif_jax.tuning.domain import held_leaves
from ewif_jax.tuning.pricing import as_float
from ewif_jax.types import Estimator, Gaussian, Measurement, Numbers, Params, PyTree

Kind = Literal["observed", "sandwich"]


class StandardErrors(NamedTuple):
    """How far parameters are known.

    errors: a pytree like the parameters: the standard error of each number, of the parameters as
        they are (not of their logarithms). 0 of what was fixed; NaN where the likelihood has no
        maximum in some direction.
    cov: (k, k) of all numbers, in the order of `jax.flatten_util.ravel_pytree`.
    params: the parameters.
    kind: "observed" or "sandwich".
    distance: () how many standard errors the maximum lies away, as far as the derivatives here can
        tell; near 0 if the parameters are tuned.
    """

    errors: PyTree
    cov: Array
    params: Params
    kind: str
    distance: Array

    def derived(self, function: Callable[[Params], PyTree]) -> "StandardErrors":
        r"""The errors of numbers made of the parameters, by the delta method.

        .. math::
            \operatorname{cov} g(p) = G \operatorname{cov}(p) G', \quad G = \partial g / \partial p

        Args:
            function: params -> any pytree of floats, differentiable.
        """
        flat, unflatten = ravel_pytree(self.params)
        value = function(self.params)
        _, unflatten_value = ravel_pytree(value)

        def made(x: Array) -> Array:
            return ravel_pytree(function(unflatten(x)))[0]

        slopes = jax.jacfwd(made)(flat)
        cov = slopes @ self.cov @ slopes.T
        errors = unflatten_value(jnp.sqrt(jnp.diagonal(cov)))
        return StandardErrors(errors, cov, value, self.kind, self.distance)

    def interval(self, level: float = 0.95) -> tuple[PyTree, PyTree]:
        """The lower and upper ends, value -+ so many standard errors as a Gaussian has to hold
        `level` (0.95: 1.96). Of a variance, those of its logarithm are better: `derived`."""
        checks.require(0 < level < 1, "level", "a number between 0 and 1", level)
        width = float(ndtri(0.5 + level / 2))
        pairs = [
            jax.tree.map(lambda x, e, s=sign: x + s * width * e, self.params, self.errors)
            for sign in (-1, 1)
        ]
        return pairs[0], pairs[1]


def standard_errors(
    estimator: Estimator,
    params: Params,
    measurements: Measurement,
    *,
    prior: Gaussian | None,
    t0: Numbers,
    kind: Kind = "observed",
    fixed: PyTree = None,
    unused: Unused = "charge",
    **setting: Any,
) -> StandardErrors:
    r"""Standard errors of parameters that maximise the likelihood.

    .. math::
        \text{observed:} \quad \operatorname{cov} &= J^{-1}, \quad
            J = -\partial^2 \log p(z_1 \dots z_T) / \partial p^2 \\
        \text{sandwich:} \quad \operatorname{cov} &= J^{-1} \Big( \tfrac{N}{N-1} \sum_j s_j s_j'
            \Big) J^{-1}, \quad s_j = \partial \log p_j / \partial p

    The observed information is right if the model is. The sandwich also holds for a filter whose
    likelihood is no model of the data (an EWIF's), for parameters that maximise it on average; its
    :math:`s_j` are the scores of the N runs, or of the rows of a single stream, which then have to
    be uncorrelated.

    Args:
        estimator: any `Estimator` whose likelihood can be differentiated twice.
        params: the parameters that `tune` found with `likelihood_loss` or `log_likelihood`.
        measurements: a stream (T, ...) or a batch (R, T, ...).
        prior, t0: as in `run`.
        kind: "observed" or "sandwich".
        fixed: which parameters are taken as exact, as in `tune`.
        unused: as in `likelihood_loss`.
        **setting: times, clock, key, ... as in `run_batch`.

    Returns:
        `StandardErrors`.

    Compiled once for an estimator and shapes, forward over reverse mode.

    Raises:
        ValueError: another kind; what `run_batch` refuses; names that are none.
    """
    checks.require(kind in ("observed", "sandwich"), "kind", "'observed' or 'sandwich'", repr(kind))
    whole, moves = held_leaves(fixed, params)
    whole = jax.tree.map(as_float, whole)
    arrays = {"prior": prior, "t0": t0, **{k: setting.pop(k) for k in _ARRAYS if k in setting}}
    options = Frozen({**setting, "unused": unused})
    rows = partial(_negative_log_likelihood, estimator, measurements, arrays, options)
    # What can be refused is refused of known numbers, before they are traced.
    jax.eval_shape(lambda: rows(whole))
    measurements = jax.tree.map(jnp.asarray, measurements)
    flags = tuple(moves)
    found = _second_order(estimator, whole, measurements, arrays, options, flags, kind)
    gradient, hessian, scores_ = (np.asarray(x, float) for x in found)
    cov, distance = _covariance_of(gradient, hessian, scores_ if kind == "sandwich" else None)
    flat, unflatten = ravel_pytree(whole)
    place = np.concatenate(
        [np.full(np.size(x), m) for x, m in zip(jax.tree.leaves(whole), moves, strict=True)]
    )
    full = np.zeros((flat.size, flat.size))
    full[np.ix_(place, place)] = cov
    spread = np.sqrt(np.diagonal(full))
    return StandardErrors(
        unflatten(jnp.asarray(spread, flat.dtype)),
        jnp.asarray(full, flat.dtype),
        whole,
        kind,
        jnp.asarray(distance, flat.dtype),
    )


_ARRAYS = ("times", "key")
"""Of the setting: what is traced; the rest decides what is compiled."""


def _negative_log_likelihood(
    estimator: Estimator,
    measurements: Measurement,
    arrays: dict[str, Any],
    options: Frozen,
    params: Params,
) -> Array:
    """Of each run and row (R, T); 0 where a row does not count."""
    setting = {**arrays, **options.tree}
    unused = setting.pop("unused")
    charging = value_charging(estimator, measurements, density_cost, unused, setting)
    values = charging.scored(params, None, scores.negative_log_likelihood)
    return jnp.where(jnp.isnan(values), 0, values)


@partial(jax.jit, static_argnames=("estimator", "options", "moves", "kind"))
def _second_order(
    estimator: Estimator,
    params: Params,
    measurements: Measurement,
    arrays: dict[str, Any],
    options: Frozen,
    moves: tuple[bool, ...],
    kind: Kind,
) -> tuple[Array, Array, Array]:
    """Gradient (k,) and Hessian (k, k) of the negative log likelihood in the parameters that move,
    and the scores (N, k)."""
    leaves, structure = jax.tree.flatten(params)
    moving = [x for x, m in zip(leaves, moves, strict=True) if m]
    flat, unflatten = ravel_pytree(moving)

    def rows(x: Array) -> Array:
        own = iter(unflatten(x))
        merged = [next(own) if m else leaf for leaf, m in zip(leaves, moves, strict=True)]
        whole = jax.tree.unflatten(structure, merged)
        return _negative_log_likelihood(estimator, measurements, arrays, options, whole)

    def total(x: Array) -> Array:
        return jnp.sum(rows(x))

    def each(x: Array) -> Array:
        found = rows(x)
        return found[0] if found.shape[0] == 1 else jnp.sum(found, -1)

    slope = jax.grad(total)
    # Forward over reverse: the gradient is one reverse pass, and its k directional derivatives
    # share it.
    hessian = jax.jacfwd(slope)(flat)
    if kind == "observed":
        return slope(flat), hessian, jnp.zeros((0, flat.size), flat.dtype)
    by_run = jax.jacfwd(each)(flat)
    return jnp.sum(by_run, 0), hessian, by_run


def _covariance_of(
    gradient: np.ndarray, hessian: np.ndarray, by_run: np.ndarray | None
) -> tuple[np.ndarray, float]:
    """The covariance (k, k), and how many standard errors the maximum is away.

    Parameters of very different sizes: solved in units in which the Hessian has a unit diagonal.
    """
    diagonal = np.diagonal(hessian)
    size = len(diagonal)
    if not (np.isfinite(hessian).all() and (diagonal > 0).all()):
        return np.full((size, size), np.nan), np.nan
    unit = 1 / np.sqrt(diagonal)
    scaled = (hessian + hessian.T) / 2 * unit * unit[:, None]
    # A Hessian that is not positive has no maximum there: NaN says so, where an inverse would give
    # errors of imaginary or arbitrary size.
    if np.linalg.eigvalsh(scaled).min() <= size * np.finfo(float).eps:
        return np.full((size, size), np.nan), np.nan
    inverse = np.linalg.inv(scaled)
    slope = gradient * unit
    distance = float(np.sqrt(slope @ inverse @ slope))
    if by_run is not None:
        count = len(by_run)
        spread = by_run * unit
        # N / (N - 1): the scores sum to zero at the maximum, which takes one degree of freedom.
        meat = spread.T @ spread * (count / max(count - 1, 1))
        inverse = inverse @ meat @ inverse
    return inverse * unit * unit[:, None], distance
