"""Runs as the last axis: mapping over it, splitting it up."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ewif_jax import checks
from ewif_jax.compiling import loops_are_joined, transformed
from ewif_jax.kernels.batched import contiguous, turned


def vmap_last(
    fn: Callable[..., Any], in_flags: Any, out_flags: Any, runs: int
) -> Callable[..., Any]:
    """`fn` mapped over the last axis, of `runs`, of the flagged inputs; its flagged outputs have
    one."""
    in_axes, out_axes = (
        jax.tree.map(lambda f: -1 if f else None, flags) for flags in (in_flags, out_flags)
    )
    flagged = any(jax.tree.leaves((in_flags, out_flags)))
    return jax.vmap(fn, in_axes, out_axes, axis_size=runs) if flagged else fn


def parted(tree: Any, flags: Any) -> tuple[list[Any], list[Any]]:
    """The leaves that are flagged, and the others."""
    pairs = list(zip(jax.tree.leaves(tree), jax.tree.leaves(flags), strict=True))
    return [x for x, f in pairs if f], [x for x, f in pairs if not f]


def joined(flagged: Sequence[Any], others: Sequence[Any], flags: Any) -> Any:
    """The tree whose leaves `parted` would part into these."""
    marked, rest = iter(flagged), iter(others)
    return jax.tree.map(lambda f: next(marked) if f else next(rest), flags)


def first_run(tree: Any, flags: Any) -> Any:
    """The first along the leading axis of the flagged leaves; NumPy stays NumPy, known known."""

    def first(x: Any, flag: bool) -> Any:
        known = checks.known(x) if flag and not _is_key(x) else None
        return x if not flag else x[0] if known is None else known[0]

    return jax.tree.map(first, tree, flags)


def runs_last(tree: Any, flags: Any) -> Any:
    """The flagged leaves with their leading axis moved to the end."""

    def trailing(x: Any, flag: bool) -> Any:
        if not flag or jnp.ndim(x) == 1:
            return x
        x = jnp.asarray(x)
        return turned(x.reshape(x.shape[0], -1)).reshape(*x.shape[1:], -1)

    return jax.tree.map(trailing, tree, flags)


def runs_first(tree: Any, flags: Any, runs: int) -> Any:
    """Every leaf with the run axis in front, repeated where it was shared."""

    def leading(x: Array, flag: bool) -> Array:
        if not flag:
            return jnp.broadcast_to(x, (runs, *x.shape))
        if x.ndim == 1:
            return x
        return turned(x.reshape(-1, runs)).reshape(runs, *x.shape[:-1])

    return jax.tree.map(leading, tree, flags)


def runs_adjacent(tree: Any, flags: Any) -> Any:
    """The flagged leaves with the runs adjacent in memory."""

    def adjacent(x: Array, flag: bool) -> Array:
        return contiguous(x) if flag and not _is_key(x) else x  # keys have no layout of their own

    return jax.tree.map(adjacent, tree, flags)


class Place(NamedTuple):
    """Where a group of runs puts what it shows: whole, arrays (R, numbers of all steps), from row
    () on."""

    whole: Any
    row: Array | int


def scan_in_blocks(
    step: Callable[[Any, Any], tuple[Any, Any]],
    state: Any,
    arrivals: Any,
    finish: Callable[[Any], Any],
    place: Place | None,
) -> tuple[Any, Any]:
    """`lax.scan` of `step`, and `finish` of what it stacks: `finish` moves the stacked axis from
    the front to place 1. Without a place for it the result has one of its own.

    The stack is finished a block of steps at a time, while it is in the cache, and put where it
    belongs, as long rows: short ones are copied slowly.
    """
    steps = jax.tree.leaves(arrivals)[0].shape[0]
    block = _block(steps)
    if block == steps and place is None:
        state, seen = lax.scan(step, state, arrivals)
        return finish(seen), state
    arrivals = jax.tree.map(lambda x: x.reshape(steps // block, block, *x.shape[1:]), arrivals)

    @partial(jax.checkpoint, prevent_cse=False)
    def several(state: Any, arrivals: Any) -> tuple[Any, Any]:
        state, seen = lax.scan(step, state, arrivals)
        return state, finish(seen)

    one = jax.tree.map(lambda x: x[0], arrivals)
    shapes = jax.eval_shape(several, state, one)[1]
    shapes = jax.tree.map(lambda x: x.update(shape=(len(x), steps, *x.shape[2:])), shapes)
    whole, row = (rows(shapes), 0) if place is None else place

    def put(carry: Any, numbered: Any) -> tuple[Any, None]:
        state, whole = carry
        number, arrivals = numbered
        state, seen = several(state, arrivals)

        def placed(whole: Array, new: Array) -> Array:
            flat = new.reshape(len(new), -1)
            return lax.dynamic_update_slice(whole, flat, (row, number * flat.shape[1]))

        return (state, jax.tree.map(placed, whole, seen)), None

    (state, whole), _ = lax.scan(put, (state, whole), (jnp.arange(steps // block), arrivals))
    return (unrolled(whole, shapes) if place is None else whole), state


def rows(shapes: Any) -> Any:
    """Zeros for what is to be shown, (R, T, ...), a row for each run."""
    return jax.tree.map(lambda x: jnp.zeros((x.shape[0], x.size // x.shape[0]), x.dtype), shapes)


def unrolled(whole: Any, shapes: Any) -> Any:
    """What is shown, (R, T, ...), from a row for each run."""
    return jax.tree.map(lambda x, shape: x.reshape(shape.shape), whole, shapes)


def _block(steps: int) -> int:
    """The largest divisor of `steps` up to 20, or all of them if there is no good one."""
    best = max(d for d in range(1, min(steps, 20) + 1) if steps % d == 0)
    return best if best >= 5 else steps


def group_size(
    runs: int, own: int, shared: int, largest: int, itemsize: int, draws: bool = False
) -> int:
    """How many runs to filter at once; 1 where a few would be too many (a state that large is a
    vector itself). What is no CPU takes all runs at once.

    The states stay in the second cache, and no array is so large that the compiler would have
    several threads wait for each other at every step. Where a loop is one function, so that
    shorter vectors cost nothing, states stay in the first cache, unless most of a state is shared:
    each group computes that again.

    Args:
        runs: how many there are.
        own: bytes of what each run has of its own in its state.
        shared: bytes of what all runs share.
        largest: bytes of the largest array in a run's state or in its estimate.
        itemsize: bytes of a number.
        draws: whether a state has random members, along which it is a vector sooner.
    """
    if jax.default_backend() != "cpu":
        return runs
    room = max(min(_SECOND_CACHE // max(own + shared, 1), _UNDIVIDED // max(largest, 1)), 1)
    if own > shared and loops_are_joined():
        room = min(room, max(_FIRST_CACHE // own, 128), 256)
    if room < (32 if draws else min(runs, 16)):
        return 1
    fewest = -(-runs // room)
    sizes = [_odd_lines(-(-runs // groups), itemsize) for groups in range(fewest, 2 * fewest + 2)]
    candidates = [size for size in sizes if min(room, 64) <= size <= min(room, runs)]
    candidates += [runs] * (runs <= room)
    return min(candidates, key=lambda size: _work(runs, size, itemsize), default=room)


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


_FIRST_CACHE, _SECOND_CACHE, _UNDIVIDED, _LINE = 2**15, 2**19, 2**18, 64


def in_groups(
    fn: Callable[[Any, Place | None], tuple[Any, Any]],
    inputs: Any,
    flags: Any,
    runs: int,
    size: int,
) -> tuple[Any, Any]:
    """`fn` of `size` runs at a time, the leading axis of the flagged leaves that go in and of all
    that come out: what is shown, which `fn` puts in its place, and the last states.

    Groups overlap where `size` does not divide the runs.
    """
    if size == runs:
        return fn(inputs, None)
    groups = -(-runs // size)
    begins = np.arange(groups) * (runs - size) // (groups - 1)

    def some(begin: Any) -> Any:
        return jax.tree.map(
            lambda x, f: lax.dynamic_slice_in_dim(x, begin, size) if f else x, inputs, flags
        )

    def one(whole: Any, begin: Any) -> tuple[Any, Any]:
        return fn(some(begin), Place(whole, begin))

    shapes = jax.eval_shape(lambda: fn(some(0), None)[0])
    shapes = jax.tree.map(lambda x: x.update(shape=(runs, *x.shape[1:])), shapes)
    whole, last = lax.scan(one, rows(shapes), jnp.asarray(begins))
    last = jax.tree.map(lambda x: x.reshape(groups * size, *x.shape[2:]), last)
    if groups * size > runs:
        found = np.searchsorted(begins, np.arange(runs), "right") - 1
        index = found * size + np.arange(runs) - begins[found]
        last = jax.tree.map(lambda x: x[index], last)
    return unrolled(whole, shapes), last


def over_devices(fn: Callable[..., Any], flags: tuple, devices: int) -> Callable[..., Any]:
    """`fn` with the runs split over the local devices: the leading axis of the flagged leaves that
    go in, and of all that come out."""
    if devices == 1:
        return fn
    split, shared = PartitionSpec("runs"), PartitionSpec()
    specs = jax.tree.map(lambda f: split if f else shared, flags)
    mesh = _mesh(devices)
    return jax.shard_map(fn, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)


def on_devices(tree: Any, flags: Any, devices: int) -> Any:
    """The known leaves put where `over_devices` wants them, wherever they were."""
    if devices == 1:
        return tree

    mesh = _mesh(devices)

    def put(x: Any, flag: bool) -> Any:
        if isinstance(x, Tracer):
            return x
        spec = PartitionSpec("runs") if flag else PartitionSpec()
        return jax.device_put(_on_host(x), NamedSharding(mesh, spec))

    return jax.tree.map(put, tree, flags)


def _on_host(x: Any) -> Any:
    """An array of one CPU device as a NumPy view of its memory, which goes to others uncopied."""
    if not isinstance(x, Array) or _is_key(x):
        return x
    here, *others = x.devices()
    return x if others or here.platform != "cpu" else np.asarray(x)


def _mesh(devices: int) -> Mesh:
    return Mesh(np.asarray(jax.local_devices()[:devices]), ("runs",))


def device_count(runs: int, devices: int | None, inputs: Any) -> int:
    """How many local devices to use: the largest number up to `devices` that divides `runs`.

    By default all, but one CPU inside another program. What that program adds up over devices they
    wait for, and XLA's CPU threads, no more than the devices, may then all wait for each other.
    """
    limit = len(jax.local_devices())
    if devices is not None:
        limit = min(checks.whole("devices", devices, 1), limit)
    elif jax.default_backend() == "cpu" and transformed(inputs):
        limit = 1
    return max(d for d in range(1, limit + 1) if runs % d == 0)


def broadcast_prefix(prefix: Any, tree: Any) -> Any:
    """A pytree of bools like `tree` from a prefix of it."""
    return jax.tree.map(lambda f, sub: jax.tree.map(lambda _: bool(f), sub), prefix, tree)


class Frozen:
    """A pytree of bools as a hashable static argument."""

    def __init__(self, tree: Any):
        self.tree = tree
        leaves, structure = jax.tree.flatten(tree)
        self._id = (tuple(leaves), structure)

    def __hash__(self) -> int:
        return hash(self._id)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Frozen) and self._id == other._id


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(jnp.asarray(x).dtype, jax.dtypes.prng_key)
