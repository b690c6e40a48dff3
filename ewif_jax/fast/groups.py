"""Runs a few at a time: how many."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax.fast.batched import turned_rows
from ewif_jax.fast.blocks import Place, Portion, like, rows, unrolled
from ewif_jax.fast.compiling import WHOLE_LOOPS_BELOW, loops_are_joined
from ewif_jax.fast.dependence import Traced
from ewif_jax.fast.layout import joined, parted, runs_last
from ewif_jax.types import PyTree


class Sizes(NamedTuple):
    """What groups of runs and blocks of steps are made to fit on a CPU.

    Found by measuring on two cores with jax 0.10.2: `README.md` has the times.
    """

    first_cache: int = 2**15
    """Bytes. Where a loop is one function, the states of a group stay in it."""
    second_cache: int = 2**19
    """Bytes. Elsewhere they stay in this one: a shorter vector costs more than a slower cache."""
    undivided: int = 2**18
    """Bytes of an array from which on XLA has several threads share a loop, and wait at every
    step: no array of a group is larger."""
    line: int = 64
    """Bytes of a cache line; a group is an odd number of them wide."""
    shown: int = 200_000
    """Bytes of what a block of short steps shows, which the second cache still holds."""
    fewest: int = 16
    """Runs. Where fewer would fit, one by one is faster: so large a state is a vector itself."""
    fewest_drawn: int = 32
    """The same of states with random members."""
    narrowest: int = 128
    """Runs of a group for the first cache, at least."""
    narrowest_together: int = 112
    """The same where steps are short, which keep about three times their state besides."""
    widest: int = 256
    """Runs of a group for the first cache, at most."""
    shortest_block: int = 5
    """Steps: with fewer, rows are copied so short that all steps at once are better."""
    block: int = 20
    """Steps of a block."""
    longest_block: int = 100
    """Steps of a block of short steps."""
    short_step: int = 1500
    """Numbers that a step computes of one run: fewer, and its loop over a group will be one
    function (a group of a hundred runs stays below `compiling.WHOLE_LOOPS_BELOW`)."""
    even_lines: float = 1.25
    """How much longer a run takes in a group of an even number of lines."""


SIZES = Sizes()


def block_size(steps: int, shown: int, together: bool) -> int:
    """How many steps to take before what they show is put in its place: the largest divisor of
    `steps` up to 20, or all of them if there is no good one. Up to 100 short ones, if what they
    show stays in the second cache.

    Args:
        steps: how many there are.
        shown: bytes of what one step shows, of all runs that are filtered at once.
        together: whether steps are so short that their loop will be one function.
    """
    short = max(SIZES.shown // max(shown, 1), SIZES.block)
    most = min(short, SIZES.longest_block) if together else SIZES.block
    best = max(d for d in range(1, min(most, steps) + 1) if steps % d == 0)
    return best if best >= SIZES.shortest_block else steps


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
    room = max(
        min(SIZES.second_cache // max(own + shared, 1), SIZES.undivided // max(largest, 1)), 1
    )
    # Narrow groups pay only where a step is not a call of XLA for each operation: those cost the
    # same for any width, and would be as many more as there are groups.
    if own > shared and loops_are_joined():
        # A short step computes about as much again, three times.
        fits = SIZES.first_cache // (4 * own if together else own)
        least = max(fits, SIZES.narrowest_together if together else SIZES.narrowest)
        room = min(room, least, SIZES.widest)
    if room < (SIZES.fewest_drawn if draws else min(runs, SIZES.fewest)):
        return 1
    fewest = -(-runs // room)
    # Up to twice the fewest groups are tried: somewhat narrower ones may overlap less and have an
    # odd number of lines (docs/decisions/fast.md and `README.md`: "A group is an odd number of
    # cache lines wide").
    sizes = [_odd_lines(-(-runs // groups), itemsize) for groups in range(fewest, 2 * fewest + 2)]
    candidates = [size for size in sizes if min(room, 64) <= size <= min(room, runs)]
    candidates += [runs] * (runs <= room)
    return min(candidates, key=lambda size: _work_of(runs, size, itemsize), default=room)


def _may_fail(size: int) -> bool:
    """Whether a loop that reads and writes so many bytes might be compiled as one function, though
    several threads would take part in that, which fails."""
    return SIZES.undivided // 2 <= size < WHOLE_LOOPS_BELOW // 2


def goes_together(step: Traced) -> bool:
    """Whether the loop over such steps, of about a hundred runs, will be one function."""
    numbers = sum(v.aval.size for eqn in step.closed.jaxpr.eqns for v in eqn.outvars)
    return loops_are_joined() and numbers < SIZES.short_step


def _odd_lines(size: int, itemsize: int) -> int:
    """The next size of a vector that is an odd number of cache lines."""
    line = SIZES.line // itemsize
    lines = -(-size // line)
    return (lines + 1 - lines % 2) * line


def _work_of(runs: int, size: int, itemsize: int) -> float:
    """Rows of an odd number of lines come to lie in all sets of a cache, others in each other's
    way: with rows of a power of two a transpose takes ten times as long."""
    lines = size * itemsize / SIZES.line
    return -(-runs // size) * size * (1 if lines % 2 == 1 else SIZES.even_lines)


def in_groups(
    fn: Callable[[Any, Place | None], tuple[Any, Any]],
    inputs: PyTree,
    flags: PyTree,
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
    # The last group begins earlier, so that all are equally wide: one program for all of them. Runs
    # that two groups share come out twice with the same numbers.
    begins = np.minimum(np.arange(groups) * size, runs - size)

    def grouped(x: Array) -> Array:
        # Not cut out inside the loop: in reverse mode each group would then add to all runs.
        if groups * size > runs:
            x = jnp.concatenate([x[: begins[-2] + size], x[begins[-1] :]])
        return x.reshape(groups, size, *x.shape[1:])

    def one_group(whole: PyTree, numbered: PyTree) -> tuple[Any, Any]:
        begin, known, group = numbered
        return fn(merged(group, begin), Place(whole, begin, known))

    split = [grouped(x) for x in flagged]
    # The whole result is made once, before the loop, and each group writes its rows into it:
    # stacked by the scan and concatenated after it, the result would be copied.
    shapes = jax.eval_shape(lambda group: fn(merged(group, 0), None)[0], [x[0] for x in split])
    shapes = jax.tree.map(lambda x: x.update(shape=(runs, *x.shape[1:])), shapes)
    whole, last = lax.scan(
        one_group, rows(shapes), (begins, np.arange(groups) * size - begins, split)
    )
    last = jax.tree.map(lambda x: x.reshape(groups * size, *x.shape[2:]), last)
    if groups * size > runs:
        last = jax.tree.map(lambda x: jnp.concatenate([x[: begins[-1]], x[-size:]]), last)
    return unrolled(whole, shapes), last
