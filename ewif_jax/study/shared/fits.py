"""The descents of `tune` for many data sets, side by side."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ewif_jax.tuning.quasi_newton import quasi_newton
from ewif_jax.types import Numbers, PyTree


class Fits(NamedTuple):
    """point (D, n): where the loss of each of D data sets is least; least (D,): its value there;
    turns: evaluations of the slowest descent."""

    point: np.ndarray
    least: np.ndarray
    turns: int


def fitted(
    loss: Callable[[Any, Any], Any],
    start: np.ndarray,
    data: PyTree,
    progress: Callable[[int, int], None] | None = None,
    at_once: int = 250,
) -> Fits:
    """Where loss(x (n,), data set) is least, for data sets that every leaf of `data` leads with.

    `at_once` of them share one batched evaluation a turn, until the last has converged.
    """
    priced = jax.jit(jax.vmap(jax.value_and_grad(loss)))
    count = len(jax.tree.leaves(data)[0])
    found = []
    for begin in range(0, count, at_once):
        some = jax.tree.map(lambda x, k=begin: jnp.asarray(x[k : k + at_once]), data)
        found.append(_side_by_side(priced, start, some))
        if progress is not None:
            progress(min(begin + at_once, count), count)
    points, least, turns = zip(*found, strict=True)
    return Fits(np.concatenate(points), np.concatenate(least), max(turns))


def _side_by_side(priced: Callable[..., Any], start: Numbers, data: PyTree) -> Fits:
    count, size = len(jax.tree.leaves(data)[0]), np.size(start)
    no_ends = np.zeros(size, bool)
    begin, widths = np.asarray(start, float), np.ones(size)
    descents = [quasi_newton(begin, widths, no_ends, 1e-12) for _ in range(count)]
    points = np.stack([next(descent) for descent in descents])
    best, least, going, turns = points.copy(), np.full(count, np.inf), set(range(count)), 0
    while going:
        values, slopes = map(np.asarray, priced(jnp.asarray(points), data))
        turns += 1
        for k in list(going):
            if values[k] < least[k]:
                best[k], least[k] = points[k], values[k]
            try:
                points[k] = descents[k].send((float(values[k]), slopes[k]))
            except StopIteration:
                going.discard(k)
    return Fits(best, least, turns)
