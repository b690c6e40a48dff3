"""How much a filter has to remember."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ewif_jax import checks
from ewif_jax.types import Estimator, Gaussian, Params, RandomKey


class Storage(NamedTuple):
    """numbers: how many floating-point numbers a state holds; bytes: of everything in it (times,
    flags, indices and random keys too); parts: numbers by the name of the field, dotted."""

    numbers: int
    bytes: int
    parts: dict[str, int]


def storage(
    estimator: Estimator, n: int, *, params: Params = None, key: RandomKey = None
) -> Storage:
    """What the state of an estimator holds, read off the state itself without computing it.

    A state holds all that the next step needs: the estimate, and whatever a method for late
    measurements keeps of the past. What it keeps beyond the filter in sequence is the difference
    of two such counts. Covariances count n (n + 1) / 2 where the filter packs them.

    Args:
        estimator: any `Estimator`.
        n: size of the state of its model.
        params: its parameters, where `init` needs them.
        key: PRNG key (default `jax.random.key(0)`).

    Returns:
        A `Storage`: numbers, bytes in the default float dtype, and numbers by field.

    Orguner & Gustafsson (32) and Pornsarayouth & Yamakita count in words what this counts in
    numbers.

    Raises:
        ValueError: n < 1; what is not an `Estimator`.
    """
    checks.estimator(estimator)
    n = checks.whole("n", n, 1)
    prior = Gaussian(jnp.zeros(n), jnp.eye(n))
    key = jax.random.key(0) if key is None else key
    state = jax.eval_shape(lambda: estimator.init(params, prior, jnp.asarray(0.0), key))
    numbers, size, parts = 0, 0, {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        size += leaf.size * leaf.dtype.itemsize
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            numbers += leaf.size
            parts[jax.tree_util.keystr(path, simple=True, separator=".")] = leaf.size
    return Storage(numbers, size, parts)
