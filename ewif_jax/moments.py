"""Means over runs and their errors, joined from chunks without losing digits."""

from typing import Any, NamedTuple

import numpy as np


class Moments(NamedTuple):
    """How many values there are at each step (T,), their mean, and the sum of the squares of what
    they differ from it."""

    count: np.ndarray
    mean: np.ndarray
    squares: np.ndarray


def combined(some: Moments, others: Moments) -> Moments:
    """The moments of both (Chan, Golub and LeVeque 1979): no squares of large numbers, whose
    difference would be lost in rounding."""
    count = some.count + others.count
    safe = np.maximum(count, 1)
    with np.errstate(invalid="ignore"):
        apart = others.mean - some.mean
        means = (some.count, some.mean), (others.count, others.mean)
        mean = sum(np.where(n > 0, n * x, 0) for n, x in means) / safe
        between = np.where(some.count * others.count > 0, apart**2, 0)
        squares = some.squares + others.squares + between * some.count * others.count / safe
    return Moments(count, np.where(count > 0, mean, np.nan), squares)


def standard_error(found: Moments) -> np.ndarray:
    """Of the mean at each step (T,); NaN with fewer than two values."""
    count = found.count
    safe = np.maximum(count - 1, 1) * np.maximum(count, 1)
    return np.where(count > 1, np.sqrt(found.squares / safe), np.nan)


def shifted(count: Any, mean: Any, total: Any, square: Any) -> Moments:
    """The moments, from sums of distances from a rounded mean."""
    safe = np.maximum(count, 1)
    return Moments(
        count,
        np.where(np.isfinite(total), mean + total / safe, mean),
        np.maximum(square - total**2 / safe, 0),
    )
