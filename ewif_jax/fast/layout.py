"""Runs as the last axis: mapping over it, splitting it up."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ewif_jax import checks
from ewif_jax.fast.batched import contiguous, turned
from ewif_jax.fast.compiling import transformed
from ewif_jax.types import Numbers, PyTree


def vmap_last(
    fn: Callable[..., Any], in_flags: PyTree, out_flags: PyTree, runs: int
) -> Callable[..., Any]:
    """`fn` mapped over the last axis, of `runs`, of the flagged inputs; its flagged outputs have
    one."""
    in_axes, out_axes = (
        jax.tree.map(lambda f: -1 if f else None, flags) for flags in (in_flags, out_flags)
    )
    flagged = any(jax.tree.leaves((in_flags, out_flags)))
    return jax.vmap(fn, in_axes, out_axes, axis_size=runs) if flagged else fn


def parted(tree: PyTree, flags: PyTree) -> tuple[list[Any], list[Any]]:
    """The leaves that are flagged, and the others."""
    pairs = list(zip(jax.tree.leaves(tree), jax.tree.leaves(flags), strict=True))
    return [x for x, f in pairs if f], [x for x, f in pairs if not f]


def joined(flagged: Sequence[PyTree], others: Sequence[PyTree], flags: PyTree) -> Any:
    """The tree whose leaves `parted` would part into these."""
    marked, rest = iter(flagged), iter(others)
    return jax.tree.map(lambda f: next(marked) if f else next(rest), flags)


def one_run(tree: PyTree, flags: PyTree, k: int = 0) -> Any:
    """Number k along the leading axis of the flagged leaves; NumPy stays NumPy, known known."""

    def of_one_run(x: Numbers, flag: bool) -> Any:
        concrete = checks.concrete_value(x) if flag and not _is_key(x) else None
        return x if not flag else x[k] if concrete is None else concrete[k]

    return jax.tree.map(of_one_run, tree, flags)


def runs_last(tree: PyTree, flags: PyTree) -> Any:
    """The flagged leaves with their leading axis moved to the end."""

    def trailing(x: Numbers, flag: bool) -> Any:
        if not flag or jnp.ndim(x) == 1:
            return x
        x = jnp.asarray(x)
        # One transpose of a matrix (runs, numbers), as a pass of its own (see `turned`).
        return turned(x.reshape(x.shape[0], -1)).reshape(*x.shape[1:], -1)

    return jax.tree.map(trailing, tree, flags)


def runs_first(tree: PyTree, flags: PyTree, runs: int) -> Any:
    """Every leaf with the run axis in front, repeated where it was shared."""

    def leading(x: Array, flag: bool) -> Array:
        if not flag:
            return jnp.broadcast_to(x, (runs, *x.shape))
        if x.ndim == 1:
            return x
        return turned(x.reshape(-1, runs)).reshape(runs, *x.shape[:-1])

    return jax.tree.map(leading, tree, flags)


def runs_adjacent(tree: PyTree, flags: PyTree) -> Any:
    """The flagged leaves with the runs adjacent in memory."""

    def adjacent(x: Array, flag: bool) -> Array:
        return contiguous(x) if flag and not _is_key(x) else x  # keys have no layout of their own

    return jax.tree.map(adjacent, tree, flags)


def over_devices(fn: Callable[..., Any], flags: tuple, devices: int) -> Callable[..., Any]:
    """`fn` with the runs split over the local devices: the leading axis of the flagged leaves that
    go in, and of all that come out."""
    if devices == 1:
        return fn
    split, shared = PartitionSpec("runs"), PartitionSpec()
    specs = jax.tree.map(lambda f: split if f else shared, flags)
    mesh = _device_mesh(devices)
    return jax.shard_map(fn, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)


def equal_part(count: int, size: int, k: int) -> np.ndarray:
    """Indices of part number k of 0 .. count - 1 in parts of one size, the last filled up with its
    last: one program does for all of them."""
    return np.minimum(np.arange(k * size, (k + 1) * size), count - 1)


def equal_parts(count: int, size: int) -> Iterator[np.ndarray]:
    """All of them, one after the other."""
    return (equal_part(count, size, k) for k in range(-(-count // size)))


def on_devices(tree: PyTree, flags: PyTree, devices: int) -> Any:
    """The known leaves put where `over_devices` wants them, wherever they were."""
    if devices == 1:
        return tree

    mesh = _device_mesh(devices)
    split, shared = (NamedSharding(mesh, spec) for spec in (PartitionSpec("runs"), PartitionSpec()))
    leaves, structure = jax.tree.flatten(tree)
    places = [split if flag else shared for flag in structure.flatten_up_to(flags)]
    placed = [i for i, x in enumerate(leaves) if not isinstance(x, Tracer)]
    there = jax.device_put([_on_host(leaves[i]) for i in placed], [places[i] for i in placed])
    for i, x in zip(placed, there, strict=True):
        leaves[i] = x
    return structure.unflatten(leaves)


def _on_host(x: Numbers) -> Any:
    """An array of one CPU device as a NumPy view of its memory, which goes to others uncopied."""
    if not isinstance(x, Array) or _is_key(x):
        return x
    here, *others = x.devices()
    return x if others or here.platform != "cpu" else np.asarray(x)


def _device_mesh(devices: int) -> Mesh:
    return Mesh(np.asarray(jax.local_devices()[:devices]), ("runs",))


def device_count(runs: int, devices: int | None) -> int:
    """How many local devices to use: the largest number up to `devices` that divides `runs`.

    By default all, but one CPU inside another program. What that program adds up over devices they
    wait for, and XLA's CPU threads, no more than the devices, may then all wait for each other.
    """
    limit = len(jax.local_devices())
    if devices is not None:
        limit = min(checks.whole("devices", devices, 1), limit)
    elif jax.default_backend() == "cpu" and transformed():
        limit = 1
    return max(d for d in range(1, limit + 1) if runs % d == 0)


def broadcast_prefix(prefix: PyTree, tree: PyTree) -> Any:
    """A pytree of bools like `tree` from a prefix of it."""
    return jax.tree.map(bool, jax.tree.broadcast(prefix, tree))


class Frozen:
    """A pytree of bools as a hashable static argument."""

    def __init__(self, tree: PyTree):
        self.tree = tree
        leaves, structure = jax.tree.flatten(tree)
        self._id = (tuple(leaves), structure)

    def __hash__(self) -> int:
        return hash(self._id)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Frozen) and self._id == other._id


def _is_key(x: Numbers) -> bool:
    return hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
