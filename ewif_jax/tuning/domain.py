"""Which leaves of the parameters move, and through which transforms: found, not guessed."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import keystr

from ewif_jax import checks
from ewif_jax.fast.layout import broadcast_prefix
from ewif_jax.transforms import Transform, negative, positive, psd, unconstrained
from ewif_jax.tuning.pricing import Pricer
from ewif_jax.tuning.programs import Leaves
from ewif_jax.types import Numbers, Params, PyTree

FRACTION = 1e-3
"""Of its scale: how far below 0 a leaf is tried that starts at 0."""
FIRST_TRIED = -8
LAST_TRIED = 8
"""Powers of ten of its scale to which a leaf that starts at 0 is moved."""

Refuses = Callable[[Leaves], bool]


class Domain(NamedTuple):
    """A transform for each moving leaf (None: it stays where it is), where each starts, and what is
    to be said of them."""

    transforms: list[Transform | None]
    start: Leaves
    notes: list[str]


def held_leaves(fixed: PyTree, params: Params) -> tuple[Params, list[bool]]:
    """The parameters with the values that are fixed, and which leaves move.

    Args:
        fixed: None; names of the top level; a mapping of some of them to bools or to the values at
            which they are held; or a pytree prefix of bools.
        params: the parameters.

    Raises:
        ValueError: names that the parameters have not; a prefix that is none.
    """
    if fixed is None:
        return params, [True] * len(jax.tree.leaves(params))
    names = [fixed] if isinstance(fixed, str) else fixed
    if isinstance(names, list | tuple | set | frozenset) and all(isinstance(x, str) for x in names):
        fixed = dict.fromkeys(names, True)
    if isinstance(fixed, Mapping) and isinstance(params, Mapping):
        values = {k: x for k, x in fixed.items() if not _are_bools(x)}
        params = {**params, **values}
        unknown = [k for k in fixed if k not in params]
        have = ", ".join(map(repr, params))
        checks.require(not unknown, "fixed", f"names of the parameters ({have})", unknown)
        fixed = {k: k in values or fixed.get(k, False) for k in params}
    try:
        stays = jax.tree.leaves(broadcast_prefix(fixed, params))
    except (ValueError, TypeError) as error:
        expected = "names, a mapping of names, or a pytree prefix of `params` of True and False"
        raise ValueError(f"fixed: expected {expected}, got {fixed!r}") from error
    return params, [not bool(x) for x in stays]


def given_transforms(transforms: PyTree, params: Params) -> list[Transform | None]:
    """The transform given for each leaf; None where it is to be found."""
    count = len(jax.tree.leaves(params))
    if transforms is None:
        return [None] * count
    if isinstance(transforms, Mapping) and isinstance(params, Mapping):
        unknown = [k for k in transforms if k not in params]
        have = ", ".join(map(repr, params))
        checks.require(not unknown, "transforms", f"names of the parameters ({have})", unknown)
        transforms = {k: transforms.get(k) for k in params}

    def is_said(x: PyTree) -> bool:
        return x is None or isinstance(x, Transform)

    def spread(said: Any, below: PyTree) -> list[Any]:
        ok = is_said(said)
        checks.require(ok, "transforms", "a Transform for each leaf", type(said).__name__)
        return [said] * len(jax.tree.leaves(below))

    try:
        parts = jax.tree.map(spread, transforms, params, is_leaf=is_said)
    except (ValueError, TypeError) as error:
        expected = "a pytree prefix of `params` of Transforms"
        raise ValueError(f"transforms: expected {expected}, got {transforms!r}") from error
    return jax.tree.leaves(parts, is_leaf=is_said)


def found_domain(
    given: Sequence[Transform | None],
    names: Sequence[str],
    start: Leaves,
    pricer: Pricer,
    refuses: Refuses,
) -> Domain:
    """The domain of every moving leaf.

    A leaf without a transform is tried with its sign flipped: where the loss refuses that, or is
    not finite, the leaf keeps its sign. A start of 0 is then moved to the smallest value that
    lowers the loss.

    Args:
        given: transforms, None where the domain is to be found.
        names: of the leaves.
        start: the moving leaves.
        pricer: the loss.
        refuses: whether the loss refuses known parameters.
    """
    leaves, notes = [jnp.asarray(x) for x in start], []
    # The loss is asked whether it takes the other sign: the sign of a start says nothing (a bias
    # may start at 1 and end at -3; docs/decisions/tuning.md: "The domain is found, not guessed").
    flipped = [_replaced_leaf(leaves, k, _sign_flipped(x)) for k, x in enumerate(leaves)]
    unsure = [k for k, t in enumerate(given) if t is None and leaves[k].size]
    refused = {k: refuses(flipped[k]) for k in unsure}
    asked = [k for k in unsure if not refused[k]]
    for k, (value, _) in zip(asked, pricer.prices([flipped[k] for k in asked]), strict=True):
        refused[k] = not np.isfinite(value)
    transforms: list[Transform | None] = [
        t or (_one_sided(leaves[k]) if refused.get(k) else unconstrained())
        for k, t in enumerate(given)
    ]
    for k in range(len(leaves)):
        if transforms[k] == positive() and np.asarray(leaves[k]).min(initial=1) == 0:
            moved = _lifted_zeros(tuple(leaves), k, pricer)
            if moved is None:
                transforms[k] = None
                notes.append(f"{names[k]} stays 0: no larger value lowers the loss")
            else:
                leaves[k] = moved
                notes.append(f"{names[k]} started at 0, moved to {float(jnp.min(moved)):.3g}")
    return Domain(transforms, tuple(leaves), notes)


def kept_signs(
    given: Sequence[Transform | None], start: Sequence[Numbers], refuses: Refuses
) -> list[Transform]:
    """The transforms given, and of other leaves: one that keeps the sign where the loss refuses
    the other, else none."""
    leaves = [jnp.asarray(x) for x in start]
    return [
        t
        or (
            _one_sided(leaves[k])
            if leaves[k].size and refuses(_replaced_leaf(leaves, k, _sign_flipped(leaves[k])))
            else unconstrained()
        )
        for k, t in enumerate(given)
    ]


def _one_sided(x: Numbers) -> Transform:
    """The transform of a leaf that keeps its sign."""
    value = np.asarray(x)
    square = value.ndim == 2 and value.shape[0] == value.shape[1]
    if square and np.allclose(value, value.T) and np.linalg.eigvalsh(value).min() > 0:
        return psd()
    if np.all(value >= 0):
        return positive()
    return negative() if np.all(value < 0) else unconstrained()


def _sign_flipped(x: Numbers) -> Any:
    scale = jnp.max(jnp.abs(x))
    # A zero has no other sign: it is moved a little below zero, in the scale of its leaf.
    return jnp.where(x == 0, -FRACTION * jnp.where(scale > 0, scale, 1), -x)


def _replaced_leaf(leaves: Sequence[Any], k: int, new: Any) -> Leaves:
    return tuple(new if i == k else x for i, x in enumerate(leaves))


def _lifted_zeros(leaves: Leaves, k: int, pricer: Pricer) -> Any:
    """Leaf k with its zeros at the smallest value that lowers the loss; None if none does."""
    leaf = leaves[k]
    scale = float(jnp.max(leaf)) or 1.0
    before = pricer.value(leaves)
    # Lower by more than rounding: otherwise any value so small that nothing changes would do.
    margin = 10 * float(jnp.finfo(leaf.dtype).eps) * (abs(before) if np.isfinite(before) else 0)
    for power in range(FIRST_TRIED, LAST_TRIED + 1):
        tried = jnp.where(leaf == 0, jnp.asarray(scale * 10.0**power, leaf.dtype), leaf)
        if pricer.value(_replaced_leaf(leaves, k, tried)) < before - margin:
            return tried
    return None


def _are_bools(x: PyTree) -> bool:
    leaves = jax.tree.leaves(x)
    return bool(leaves) and all(isinstance(v, bool | np.bool_) for v in leaves)


def leaf_names(params: Params) -> list[str]:
    """What each leaf is called."""
    paths = jax.tree.leaves_with_path(params)
    return [keystr(path, simple=True, separator=".") or "params" for path, _ in paths]
