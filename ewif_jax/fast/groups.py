"""Runs a few at a time: how many, and where a group puts what it shows."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax.fast.batched import turned_rows
from ewif_jax.fast.compiling import WHOLE_LOOPS_BELOW, loops_are_joined
from ewif_jax.fast.dependence import Traced
from ewif_jax.fast.layout import joined, parted, runs_last


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
    known: Array | int
    """How many of its first rows the group before has put there already."""


def scan_in_blocks(
    step: Callable[[Any, Any], tuple[Any, Any]],
    state: Any,
    arrivals: Any,
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

    def numbered_step(state: Any, numbered: Any) -> tuple[Any, Any]:
        k, arrival = numbered
        if portion.together:  # otherwise several threads would take part in reading from the whole
            whole = jax.tree.map(lambda x: lax.dynamic_index_in_dim(x, k, keepdims=False), arrivals)
            arrival = jax.tree.map(like, arrival, whole)
        return step(state, arrival)

    @partial(jax.checkpoint, prevent_cse=False)
    def several(state: Any, numbered: Any) -> tuple[Any, Any]:
        state, seen = lax.scan(numbered_step, state, numbered)
        return state, finish(seen)

    first = jax.tree.map(lambda x: x[0], blocks)
    shapes = jax.eval_shape(several, state, first)[1]
    shapes = jax.tree.map(lambda x: x.update(shape=(len(x), steps, *x.shape[2:])), shapes)
    whole, row, known = (rows(shapes), 0, 0) if place is None else place

    def put(carry: Any, numbered: Any) -> tuple[Any, None]:
        state, whole = carry
        number, some = numbered
        state, seen = several(state, some)

        def put_one(whole: Array, new: Array) -> Array:
            flat = new.reshape(len(new), -1)
            return _placed(whole, flat, jnp.stack([row, number * flat.shape[1]]), known)

        return (state, jax.tree.map(put_one, whole, seen)), None

    (state, whole), _ = lax.scan(put, (state, whole), (jnp.arange(steps // block), blocks))
    return (unrolled(whole, shapes) if place is None else whole), state


def like(part: Array, same: Array) -> Array:
    """`part` of an array, read from the whole as `same`, which saves a copy of the part; but its
    slopes are those of the part: what is read from a whole adds slopes to all of it."""
    floats = jnp.issubdtype(part.dtype, jnp.floating)
    return _like(part, lax.stop_gradient(same)) if floats else same


@jax.custom_jvp
def _like(part: Array, same: Array) -> Array:
    del part
    return same


@_like.defjvp
def _like_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    return primals[1], tangents[0]


@jax.custom_jvp
def _placed(whole: Array, new: Array, at: Array, known: Array | int) -> Array:
    """`new` in its place in `whole`, which has zeros there, but for `known` first rows of `new`."""
    del known
    return lax.dynamic_update_slice(whole, new, tuple(at))


@_placed.defjvp
def _placed_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    """Slopes are added, not put. The transpose of adding leaves the whole as it is; that of putting
    clears it in the place, for which the compiler copies the whole, each time."""
    whole, new, at, known = primals
    fresh = jnp.arange(len(new))[:, None] >= known
    numbers = lax.ScatterDimensionNumbers((0, 1), (), (0, 1))
    slope = lax.scatter_add(
        tangents[0], at, jnp.where(fresh, tangents[1], 0), numbers, unique_indices=True
    )
    return _placed(whole, new, at, known), slope


def rows(shapes: Any) -> Any:
    """Zeros for what is to be shown, (R, T, ...), a row for each run."""
    return jax.tree.map(lambda x: jnp.zeros((x.shape[0], x.size // x.shape[0]), x.dtype), shapes)


def unrolled(whole: Any, shapes: Any) -> Any:
    """What is shown, (R, T, ...), from a row for each run."""
    return jax.tree.map(lambda x, shape: x.reshape(shape.shape), whole, shapes)


def block_size(steps: int, shown: int, together: bool) -> int:
    """How many steps to take before what they show is put in its place: the largest divisor of
    `steps` up to 20, or all of them if there is no good one. Up to 100 short ones, if what they
    show stays in the second cache.

    Args:
        steps: how many there are.
        shown: bytes of what one step shows, of all runs that are filtered at once.
        together: whether steps are so short that their loop will be one function.
    """
    most = min(max(_BLOCK // max(shown, 1), 20), 100) if together else 20
    best = max(d for d in range(1, min(most, steps) + 1) if steps % d == 0)
    return best if best >= 5 else steps


def group_size(
    runs: int,
    own: int,
    shared: int,
    largest: int,
    itemsize: int,
    together: bool = False,
    draws: bool = False,
) -> int:
    """How many runs to filter at once; 1 where a few would be too many (a state that large is a
    vector itself). What is no CPU takes all runs at once.

    The states stay in the second cache, and no array is so large that the compiler would have
    several threads wait for each other at every step. Where a loop is one function, so that
    shorter vectors cost nothing, states stay in the first cache, and with them what a short step
    computes; unless most of a state is shared: each group computes that again.

    Args:
        runs: how many there are.
        own: bytes of what each run has of its own in its state.
        shared: bytes of what all runs share.
        largest: bytes of the largest array in a run's state or in its estimate.
        itemsize: bytes of a number.
        together: whether a step is so short that its loop will be one function.
        draws: whether a state has random members, along which it is a vector sooner.
    """
    if jax.default_backend() != "cpu":
        return runs
    room = max(min(_SECOND_CACHE // max(own + shared, 1), _UNDIVIDED // max(largest, 1)), 1)
    if own > shared and loops_are_joined():
        # A short step computes about as much again, three times.
        least = max(_FIRST_CACHE // (4 * own), 112) if together else max(_FIRST_CACHE // own, 128)
        room = min(room, least, 256)
    if room < (32 if draws else min(runs, 16)):
        return 1
    fewest = -(-runs // room)
    sizes = [_odd_lines(-(-runs // groups), itemsize) for groups in range(fewest, 2 * fewest + 2)]
    candidates = [size for size in sizes if min(room, 64) <= size <= min(room, runs)]
    candidates += [runs] * (runs <= room)
    return min(candidates, key=lambda size: _work(runs, size, itemsize), default=room)


def _may_fail(size: int) -> bool:
    """Whether a loop that reads and writes so many bytes might be compiled as one function, though
    several threads would take part in that, which fails."""
    return _UNDIVIDED // 2 <= size < WHOLE_LOOPS_BELOW // 2


def goes_together(step: Traced) -> bool:
    """Whether the loop over such steps, of about a hundred runs, will be one function."""
    numbers = sum(v.aval.size for eqn in step.closed.jaxpr.eqns for v in eqn.outvars)
    return loops_are_joined() and numbers < 1000


def _odd_lines(size: int, itemsize: int) -> int:
    """The next size of a vector that is an odd number of cache lines."""
    line = _LINE // itemsize
    lines = -(-size // line)
    return (lines + 1 - lines % 2) * line


def _work(runs: int, size: int, itemsize: int) -> float:
    """Rows of an odd number of lines come to lie in all sets of a cache, others in each other's
    way: with rows of a power of two a transpose takes ten times as long."""
    lines = size * itemsize / _LINE
    return -(-runs // size) * size * (1 if lines % 2 == 1 else 1.25)


_FIRST_CACHE, _SECOND_CACHE, _BLOCK, _UNDIVIDED, _LINE = 2**15, 2**19, 200_000, 2**18, 64


def in_groups(
    fn: Callable[[Any, Place | None], tuple[Any, Any]],
    inputs: Any,
    flags: Any,
    runs: int,
    portion: Portion,
) -> tuple[Any, Any]:
    """`fn` of a few runs at a time: the last axis of the flagged leaves that go in (one run is no
    axis), and the leading one of all that come out: what is shown, which `fn` puts in its place,
    and the last states.

    Groups overlap where their size does not divide the runs.
    """
    size = portion.runs
    flagged, others = parted(inputs, flags)

    def behind(some: Array, whole: Array, begin: Array | int) -> Array:
        """Some runs of the whole, behind what each of them has."""
        if size == 1:
            return some[0]
        last = runs_last(some, True)
        if some.ndim == 1 or not portion.together or _may_fail(some.size * some.dtype.itemsize):
            return last
        return like(last, turned_rows(whole.reshape(runs, -1), begin, size).reshape(last.shape))

    def merged(group: Sequence[Array], begin: Array | int) -> Any:
        own = [behind(some, whole, begin) for some, whole in zip(group, flagged, strict=True)]
        return joined(own, others, flags)

    if size == runs:
        return fn(merged(flagged, 0), None)
    groups = -(-runs // size)
    begins = np.minimum(np.arange(groups) * size, runs - size)

    def grouped(x: Array) -> Array:
        # Not cut out inside the loop: in reverse mode each group would then add to all runs.
        if groups * size > runs:
            x = jnp.concatenate([x[: begins[-2] + size], x[begins[-1] :]])
        return x.reshape(groups, size, *x.shape[1:])

    def one(whole: Any, numbered: Any) -> tuple[Any, Any]:
        begin, known, group = numbered
        return fn(merged(group, begin), Place(whole, begin, known))

    split = [grouped(x) for x in flagged]
    shapes = jax.eval_shape(lambda group: fn(merged(group, 0), None)[0], [x[0] for x in split])
    shapes = jax.tree.map(lambda x: x.update(shape=(runs, *x.shape[1:])), shapes)
    whole, last = lax.scan(one, rows(shapes), (begins, np.arange(groups) * size - begins, split))
    last = jax.tree.map(lambda x: x.reshape(groups * size, *x.shape[2:]), last)
    if groups * size > runs:
        last = jax.tree.map(lambda x: jnp.concatenate([x[: begins[-1]], x[-size:]]), last)
    return unrolled(whole, shapes), last
