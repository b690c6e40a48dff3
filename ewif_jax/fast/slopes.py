"""Slopes of a long loop in a few numbers: computed along with its values, in either mode.

Reverse mode keeps what every step computed, reads it again backwards, and costs six to seven times
the loop. The derivative of a loop in two numbers can be computed beside its values instead, in one
pass that costs less than two; what reverse mode then has left to do is a product. Example: a loss
of a tau and an r asks for J' g, with J (numbers of all outputs, 2) from that pass. (README.md:
"Slopes in a few numbers".)
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero
from jax.dtypes import float0
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from ewif_jax.types import PyTree

FEW = 4
"""Numbers: of more, reverse mode is faster."""


def with_few_slopes(fn: Callable[..., Any], per_run: PyTree) -> Callable[..., Any]:
    """`fn`, differentiated in few numbers, shared or of each run, as described above.

    Args:
        fn: function of pytrees. If any leaf that goes in is marked as one of each run, every leaf
            that comes out has a leading axis of runs, and what a run gives depends on its own.
        per_run: which leaves of the arguments have a leading axis of runs.
    """
    marks = jax.tree.leaves(per_run)

    def call(*inputs: Any) -> Any:
        leaves, structure = jax.tree.flatten(inputs)

        def of_leaves(*leaves: Array) -> Any:
            return fn(*jax.tree.unflatten(structure, leaves))

        # What `fn` closes over may be differentiated, too: it becomes an argument.
        closed, shape = jax.make_jaxpr(of_leaves, return_shape=True)(*leaves)
        count, results = len(leaves), jax.tree.structure(shape)

        def of_all(*xs: Array) -> Any:
            own = ClosedJaxpr(closed.jaxpr, xs[count:])
            return jax.tree.unflatten(results, jaxpr_as_fun(own)(*xs[:count]))

        each = [*marks, *(False for _ in closed.consts)]
        return _with_slopes(of_all, each)(*leaves, *closed.consts)

    return call


def _with_slopes(fn: Callable[..., Any], per_run: Sequence[bool]) -> Callable[..., Any]:
    @jax.custom_jvp
    def call(*xs: Array) -> Any:
        return fn(*xs)

    def slopes(primals: Sequence[Array], tangents: Sequence[Any]) -> tuple[Any, Any]:
        active = [k for k, t in enumerate(tangents) if not isinstance(t, SymbolicZero)]

        def of_active(some: Sequence[Array]) -> Any:
            whole = list(primals)
            for k, x in zip(active, some, strict=True):
                whole[k] = x
            return fn(*whole)

        start, moved = ([xs[k] for k in active] for xs in (primals, tangents))
        each = [per_run[k] for k in active]
        widths = [x.size // (len(x) if own else 1) for x, own in zip(start, each, strict=True)]
        # Symbolic zeros tell which inputs move at all. With many numbers the columns would cost
        # more than they save, and plain `jvp` lets JAX choose the mode as ever.
        if not 0 < sum(widths) <= FEW:
            return jax.jvp(of_active, (start,), (moved,))
        return _in_columns(of_active, start, moved, each, widths)

    call.defjvp(slopes, symbolic_zeros=True)
    return call


def _in_columns(
    fn: Callable[[Any], Any],
    start: list[Array],
    moved: list[Array],
    per_run: Sequence[bool],
    widths: Sequence[int],
) -> tuple[Any, Any]:
    """`fn(start)`, and its derivative by one column for each number that moves."""
    count = sum(widths)
    ends = np.cumsum([0, *widths])

    def direction(column: Array) -> list[Array]:
        """Moves one number, in every run."""
        parts = [column[a:b] for a, b in pairwise(ends)]
        shapes = [x.shape[1:] if own else x.shape for x, own in zip(start, per_run, strict=True)]
        return [
            jnp.broadcast_to(part.reshape(shape).astype(x.dtype), x.shape)
            for part, shape, x in zip(parts, shapes, start, strict=True)
        ]

    def pair(columns: Array) -> tuple[Any, Any]:
        """Values and slopes in two directions, which share the pass of the values.

        The second derivative is not used, so the compiler leaves it out.
        """
        first, second = map(direction, columns)
        # Two slopes in one pass: the derivative in direction v of the pair (f, its slope along u)
        # is the pair (slope along v, mixed second derivative). So f itself is computed once for
        # both, and the mixed derivative, which nobody reads, is dropped by the compiler
        # (docs/decisions/fast.md).
        (out, one), (other, _) = jax.jvp(lambda x: jax.jvp(fn, (x,), (first,)), (start,), (second,))
        return out, jax.tree.map(lambda *both: _stacked_slopes(both), one, other)

    if count == 1:
        out, slope = jax.jvp(fn, (start,), (direction(jnp.ones(1)),))
        columns = jax.tree.map(lambda x: _stacked_slopes([x]), slope)
    elif count == 2:
        out, columns = pair(jnp.eye(2))
    else:
        # Three or four directions go in turns of two. An odd number is filled up with a direction
        # of zeros, whose column is cut off again: one program for both turns.
        turns = jnp.eye(count + count % 2, count).reshape(-1, 2, count)
        outs, found = lax.map(pair, turns)
        out = jax.tree.map(lambda x: x[0], outs)
        columns = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], found)
    steps = [
        (x.reshape(len(x), -1).T if own else x.reshape(-1))
        for x, own in zip(moved, per_run, strict=True)
    ]
    # The true tangent enters only here, linearly: this sum is what reverse mode transposes, so the
    # loop above is never run backwards. In a batch a parameter of each run moves only its own run,
    # so that one column serves all runs (the Jacobian is block diagonal).
    taken = [step for x in steps for step in x]
    return out, jax.tree.map(lambda x, column: _along_columns(x, column, taken), out, columns)


def _stacked_slopes(parts: Sequence[Array]) -> Any:
    return parts[0] if parts[0].dtype == float0 else jnp.stack(parts)


def _along_columns(value: Array, columns: Array, steps: Sequence[Array]) -> Any:
    """How far a value moves if every number takes its step, () or (R,)."""
    if not jnp.issubdtype(value.dtype, jnp.floating):
        return np.zeros(value.shape, float0)
    wide = [x.reshape(x.shape + (1,) * (value.ndim - x.ndim)) if x.ndim else x for x in steps]
    return sum(x.astype(value.dtype) * column for x, column in zip(wide, columns, strict=True))
