"""Steps a few at a time, and where a group of runs puts what they show."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax.types import PyTree, State


class Portion(NamedTuple):
    """What is done at once."""

    runs: int
    steps: int
    together: bool
    """Whether the loop over the steps will be one function."""


class Place(NamedTuple):
    """Where a group of runs puts what it shows: whole, arrays (R, numbers of all steps), from row
    () on."""

    whole: Any
    row: Array | int
    already_there: Array | int
    """How many of its first rows the group before has put there already."""


def scan_in_blocks(
    step: Callable[[Any, Any], tuple[Any, Any]],
    state: State,
    arrivals: PyTree,
    finish: Callable[[Any], Any],
    portion: Portion,
    place: Place | None,
) -> tuple[Any, Any]:
    """`lax.scan` of `step`, and `finish` of what it stacks: `finish` moves the stacked axis from
    the front to place 1. Without a place for it the result has one of its own.

    The stack is finished a block of steps at a time, while it is in the cache, and put where it
    belongs, as long rows: short ones are copied slowly. The portion's steps divide all steps.
    """
    steps, block = jax.tree.leaves(arrivals)[0].shape[0], portion.steps
    if block == steps and place is None:
        state, seen = lax.scan(step, state, arrivals)
        return finish(seen), state
    numbered = jnp.arange(steps), arrivals
    blocks = jax.tree.map(lambda x: x.reshape(steps // block, block, *x.shape[1:]), numbered)

    def numbered_step(state: State, numbered: PyTree) -> tuple[Any, Any]:
        k, arrival = numbered
        if portion.together:  # otherwise several threads would take part in reading from the whole
            whole = jax.tree.map(lambda x: lax.dynamic_index_in_dim(x, k, keepdims=False), arrivals)
            arrival = jax.tree.map(like, arrival, whole)
        return step(state, arrival)

    # Reverse mode then keeps the states between blocks and computes the steps of a block again,
    # instead of keeping all steps. Inside a scan nothing can merge the two computations, so the
    # barrier against that, which costs copies, is left out.
    @partial(jax.checkpoint, prevent_cse=False)
    def several(state: State, numbered: PyTree) -> tuple[Any, Any]:
        state, seen = lax.scan(numbered_step, state, numbered)
        return state, finish(seen)

    first = jax.tree.map(lambda x: x[0], blocks)
    shapes = jax.eval_shape(several, state, first)[1]
    shapes = jax.tree.map(lambda x: x.update(shape=(len(x), steps, *x.shape[2:])), shapes)
    whole, row, already_there = (rows(shapes), 0, 0) if place is None else place

    def put_block(carry: PyTree, numbered: PyTree) -> tuple[Any, None]:
        state, whole = carry
        number, some = numbered
        state, seen = several(state, some)

        def put_one(whole: Array, new: Array) -> Array:
            flat = new.reshape(len(new), -1)
            return _placed_rows(
                whole, flat, jnp.stack([row, number * flat.shape[1]]), already_there
            )

        return (state, jax.tree.map(put_one, whole, seen)), None

    (state, whole), _ = lax.scan(put_block, (state, whole), (jnp.arange(steps // block), blocks))
    return (unrolled(whole, shapes) if place is None else whole), state


def like(part: Array, same: Array) -> Array:
    """`part` of an array, read from the whole as `same`, which saves a copy of the part; but its
    slopes are those of the part: what is read from a whole adds slopes to all of it."""
    return _value_like(part, same) if jnp.issubdtype(part.dtype, jnp.floating) else same


# Why not plain `same`: the loop over groups reads its part from one whole array. In reverse mode
# the slope of such a read is an array as large as the whole, zero but for the part, and it is added
# for every part. The part itself is an input of the loop, whose slopes are stacked as they come. So
# values come from the whole (no copy: a tenth of the time where only the mean is computed) and
# slopes go to the part. Example: whole = [a, b, c, d], part = [c, d]. like(part, whole[2:]) has the
# value [c, d] and the slope of `part`, and none of `whole`. Both are the same numbers, so the
# derivative is exact. JAX may drop the rule below once a program has been differentiated (inside of
# `checkpoint` it does); `same` then has its own slope, which is as right, for the next derivative.
# (README.md: "Short steps read from the whole".)
@jax.custom_jvp
def _value_like(part: Array, same: Array) -> Array:
    del part
    return same


@_value_like.defjvp
def _like_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    return _value_like(*primals), tangents[0]


# Why not the derivative of `dynamic_update_slice`: its transpose hands back the slopes of the whole
# with zeros in the place that was written. XLA copies the whole for that at every block of every
# group (with 8192 runs a gradient took 2.8 s). The place holds zeros before it is written, so
# writing is adding there, and the transpose of adding leaves the slopes of the whole as they are
# (0.17 s). Example: whole = [0, 0, 0] and new = [x] at 1 give [0, x, 0]; slopes [p, q, r] go to new
# as [q] and to whole as [p, q, r], where nobody reads the q of a constant zero. Rows that the group
# before has written (`already_there`) are not zeros; their slopes stay with that group.
# (README.md: "Slopes of a group are added to the whole".)
@jax.custom_jvp
def _placed_rows(whole: Array, new: Array, at: Array, already_there: Array | int) -> Array:
    """`new` in its place in `whole`, which has zeros there, but for the first rows of `new`."""
    del already_there
    return lax.dynamic_update_slice(whole, new, tuple(at))


@_placed_rows.defjvp
def _placed_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    """Slopes are added, not put. The transpose of adding leaves the whole as it is; that of putting
    clears it in the place, for which the compiler copies the whole, each time."""
    whole, new, at, already_there = primals
    # Groups overlap: rows that the group before has put there would otherwise add their slope
    # twice.
    fresh = jnp.arange(len(new))[:, None] >= already_there
    numbers = lax.ScatterDimensionNumbers((0, 1), (), (0, 1))
    slope = lax.scatter_add(
        tangents[0], at, jnp.where(fresh, tangents[1], 0), numbers, unique_indices=True
    )
    return _placed_rows(whole, new, at, already_there), slope


def rows(shapes: PyTree) -> Any:
    """Zeros for what is to be shown, (R, T, ...), a row for each run."""
    return jax.tree.map(lambda x: jnp.zeros((x.shape[0], x.size // x.shape[0]), x.dtype), shapes)


def unrolled(whole: PyTree, shapes: PyTree) -> Any:
    """What is shown, (R, T, ...), from a row for each run."""
    return jax.tree.map(lambda x, shape: x.reshape(shape.shape), whole, shapes)
