"""Where a search begins, from what the user says of it."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ewif_jax import checks
from ewif_jax.tuning.pricing import Coordinates, has_ends
from ewif_jax.tuning.programs import Leaves
from ewif_jax.types import Params, PyTree

SPREAD = float(np.log(100.0))
"""How far starts spread about the parameters, either way: in logarithms a factor 100."""


def start_count(starts: PyTree) -> int:
    """How many there are, if it is a number; else 1."""
    return checks.whole("starts", starts, 1) if isinstance(starts, int) else 1


def start_leaves(starts: PyTree, params: Params) -> list[list[Any]]:
    """The leaves of each starting point; none if `starts` are a number, or not given."""
    if starts is None or isinstance(starts, int):
        return []
    expected = "a pytree like `params` with a leading axis of S starts, or a list of such as it"
    if isinstance(starts, list) and not isinstance(params, list):
        trees = starts
    else:
        sizes = {np.shape(x)[0] if np.ndim(x) else 0 for x in jax.tree.leaves(starts)}
        ok = len(sizes) == 1 and min(sizes) > 0
        checks.require(ok, "starts", expected, f"leading axes {sorted(sizes)}")
        trees = [jax.tree.map(lambda x, k=k: jnp.asarray(x)[k], starts) for k in range(sizes.pop())]
    found = []
    for tree in trees:
        if isinstance(tree, dict) and isinstance(params, dict):
            tree = {**params, **tree}
        structure = jax.tree.structure(tree)
        checks.require(structure == jax.tree.structure(params), "starts", expected, structure)
        like = jax.tree.map(lambda x, p: jnp.asarray(x, p.dtype), tree, params)
        fits = all(
            x.shape == p.shape
            for x, p in zip(jax.tree.leaves(like), jax.tree.leaves(params), strict=True)
        )
        checks.require(fits, "starts", expected, jax.tree.map(np.shape, tree))
        found.append(jax.tree.leaves(like))
    checks.require(bool(found), "starts", expected, "none")
    return found


def start_points(
    starts: PyTree, first: Leaves, others: Sequence[Leaves], coordinates: Coordinates
) -> list[np.ndarray]:
    """The free numbers (n,) of each starting point.

    Args:
        starts: as the user said.
        first: the moving leaves of the first start.
        others: those of the others, if all were given.
        coordinates: their free numbers.
    """
    centre = coordinates.vector(first)
    if others or not isinstance(starts, int):
        found = [coordinates.vector(leaves) for leaves in others]
        # A start of 0 is moved where the first was.
        return [centre, *(np.where(x == -np.inf, centre, x) for x in found)]
    spread = SPREAD * step_widths(centre, coordinates)
    return [centre, *(centre + spread * (2 * even_points(starts - 1, centre.size) - 1))]


def even_points(count: int, size: int) -> np.ndarray:
    """Points (count, size) in the unit cube that lie apart from each other (a Kronecker sequence
    of the generalised golden ratio)."""
    ratio = 2.0
    for _ in range(50):
        ratio = (1 + ratio) ** (1 / (size + 1))
    return (0.5 + np.outer(np.arange(1, count + 1), ratio ** -np.arange(1.0, size + 1))) % 1


def step_widths(point: np.ndarray, coordinates: Coordinates) -> np.ndarray:
    """What a step of some size is in each free number: 1 of a logarithm, else its leaf's scale."""
    parts = [np.ravel(x) for x in coordinates.split(point)]
    scales = [
        1.0 if has_ends(t) or not x.size or not np.abs(x).max() else np.abs(x).max()
        for t, x in zip(coordinates.transforms, parts, strict=True)
    ]
    return coordinates.each(scales)
