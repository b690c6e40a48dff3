"""Profile intervals: how far a parameter can go before the likelihood has fallen too far."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import ndtri

from ewif_jax import checks
from ewif_jax.losses import log_likelihood
from ewif_jax.tuning.domain import given_transforms, kept_signs, leaf_names
from ewif_jax.tuning.pricing import Coordinates, Pricer, as_float
from ewif_jax.tuning.programs import Objective
from ewif_jax.tuning.quasi_newton import quasi_newton
from ewif_jax.types import Estimator, Gaussian, Measurement, Numbers, Params, PyTree

FARTHEST = 25.0
"""How far in a free number an end is looked for: ten decades of what moves in logarithms."""
ROUNDING = 1e-10


class ProfileIntervals(NamedTuple):
    """low and high: pytrees like the parameters. An end that the likelihood never reaches is that
    of the domain: 0 of a variance, infinity."""

    low: PyTree
    high: PyTree


def profile_intervals(
    estimator: Estimator,
    params: Params,
    measurements: Measurement,
    *,
    prior: Gaussian | None,
    t0: Numbers,
    level: float = 0.95,
    transforms: PyTree = None,
    **setting: Any,
) -> ProfileIntervals:
    r"""The intervals of single numbers by the likelihood ratio.

    .. math::
        \{ x_i : 2 (\max_x \log p(z | x) - \max_{x_j, j \ne i} \log p(z | x)) \le \chi^2_1(level) \}

    They need no parabola: they are lopsided where the likelihood is, do not depend on whether a
    variance or its logarithm is asked for, and may reach 0.

    Args:
        estimator, measurements, prior, t0, setting: as in `log_likelihood`.
        params: single numbers, at the maximum of the likelihood (from `tune`).
        level: the probability that an interval holds its number.
        transforms: as in `posterior`.

    Raises:
        ValueError: a parameter that is an array; a level that is none; what `log_likelihood`
            refuses.
    """
    checks.require(0 < level < 1, "level", "a number between 0 and 1", level)
    params = jax.tree.map(as_float, params)
    leaves, structure = jax.tree.flatten(params)
    names = leaf_names(params)
    for name, x in zip(names, leaves, strict=True):
        checks.require(np.ndim(x) == 0, f"params[{name!r}]", "a number", f"shape {np.shape(x)}")

    def loss(own: Params) -> Array:
        return -log_likelihood(estimator, own, measurements, prior=prior, t0=t0, **setting)

    def refuses(own: tuple[Any, ...]) -> bool:
        try:
            jax.eval_shape(lambda: loss(jax.tree.unflatten(structure, own)))
        except ValueError:
            return True
        return False

    jax.eval_shape(lambda: loss(params))
    found = kept_signs(given_transforms(transforms, params), leaves, refuses)
    coordinates = Coordinates(found, tuple(leaves))
    pricer = Pricer(Objective(loss, None, structure, (True,) * len(leaves)), (), 1, None)

    def priced(point: np.ndarray) -> tuple[float, np.ndarray]:
        value, slopes = pricer.prices([coordinates.leaves(point)])[0]
        return value, coordinates.slopes(point, slopes)

    best = coordinates.vector(tuple(leaves))
    lowest, has_ends = priced(best)[0], coordinates.each_has_ends
    drop = float(ndtri(0.5 + level / 2))
    ends = []
    for sign in (-1, 1):
        far = [
            _interval_end(priced, best, lowest, k, sign, drop, has_ends) for k in range(len(leaves))
        ]
        moved = [coordinates.leaves(_moved_number(best, k, x))[k] for k, x in enumerate(far)]
        ends.append(moved)
    low, high = (jax.tree.unflatten(structure, [jnp.asarray(x) for x in side]) for side in ends)
    return ProfileIntervals(low, high)


def _interval_end(
    priced: Callable[[np.ndarray], tuple[float, np.ndarray]],
    best: np.ndarray,
    lowest: float,
    k: int,
    sign: int,
    drop: float,
    has_ends: np.ndarray,
) -> float:
    """The free number k at which the signed root of the likelihood ratio is `drop`."""
    from scipy.optimize import brentq  # here: the import takes longer than the search

    others = best.copy()

    def excess(distance: float) -> float:
        nonlocal others
        moved = _moved_number(others, k, best[k] + sign * distance)
        # The others start from where they were best for the last distance: the profile is followed
        # like a path, and stays in its valley.
        others, value = _least_loss(priced, moved, k, has_ends)
        # The signed root is nearly a straight line in the distance where the ratio is a parabola,
        # which is what a secant step wants. What is not finite counts as far outside.
        root = np.sqrt(2 * max(value - lowest, 0.0)) if np.isfinite(value) else 1e6
        return float(root - drop)

    inside, outside = 0.0, 0.1
    while excess(outside) < 0:
        inside, outside = outside, 2 * outside
        if outside > FARTHEST:
            return sign * np.inf
    root: Any = brentq(excess, inside, outside, xtol=1e-6)
    return float(best[k] + sign * root)


def _least_loss(
    priced: Callable[[np.ndarray], tuple[float, np.ndarray]],
    point: np.ndarray,
    k: int,
    has_ends: np.ndarray,
) -> tuple[np.ndarray, float]:
    """The point at which the loss is least while number k stays, and the loss."""
    free = np.arange(len(point)) != k
    if not free.any():
        return point, priced(point)[0]
    size = int(free.sum())
    # It looks around: where q tends to 0 the likelihood is flat, and rises again further on.
    asking = quasi_newton(point[free], np.ones(size), has_ends[free], ROUNDING)
    asked, least = next(asking), (point, np.inf)
    while True:
        whole = point.copy()
        whole[free] = asked
        value, gradient = priced(whole)
        if value < least[1]:
            least = whole, value
        try:
            asked = asking.send((value, gradient[free]))
        except StopIteration:
            return least


def _moved_number(point: np.ndarray, k: int, to: float) -> np.ndarray:
    moved = point.copy()
    moved[k] = to
    return moved
