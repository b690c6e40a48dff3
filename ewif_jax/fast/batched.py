"""Functions of small matrices that stay fast under `vmap` on a CPU.

XLA's CPU backend turns a batch of small linear algebra into one scalar loop per matrix, puts the
batch in front, and computes cheap-looking chains again for every element that reads them. A
`kernel` is written for matrices on its leading axes and any batch axes behind them: `vmap` adds
one more trailing (contiguous) axis, so that every operation is one long vector operation, and a
batched kernel stays a function of its own in the compiled program, across which nothing is
recomputed. Derivatives, of any order and in both modes, come from the function itself.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import cache, reduce, wraps
from operator import add
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.core import ShapedArray
from jax.experimental.layout import Layout, with_layout_constraint
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from ewif_jax.types import DTypeLike

Function = Callable[..., Any]
_ADJOINTS: dict[Function, Function] = {}
_CHEAP: set[Function] = set()
_APART: set[Function] = set()
"""Kept as functions of their own even without a batch."""


def kernel(fn: Function, cheap: bool = False) -> Function:
    """`fn`, batched along trailing axes.

    `fn` takes arrays and returns a float array, or a tuple of them. The trailing axes of its
    arguments, equally many for all, are equal or 1: it must treat them elementwise. `cheap`:
    computing it again costs less than keeping it.
    """
    if cheap:
        _CHEAP.add(fn)

    @wraps(fn)
    def call(*args: Any) -> Any:
        out = _kernel_p.bind(*map(jnp.asarray, args), fn=fn, batch=0)
        return tuple(out) if len(out) > 1 else out[0]

    return call


def linear_kernel(fn: Function, adjoint: Function, cheap: bool = False) -> Function:
    """The kernel of a linear function of one array whose adjoint is known."""
    _ADJOINTS[fn], _ADJOINTS[adjoint] = adjoint, fn
    return kernel(fn, cheap)


def kept_apart(fn: Function) -> Function:
    """`fn`, for `stage`: a function of its own in the program without a batch too.

    Otherwise the compiler fuses a chain of stages into every number that is read at its end, and
    computes and compiles the whole chain again for each of them.
    """
    _APART.add(fn)
    return fn


def total(terms: Iterable[Array]) -> Array:
    """The sum of at least one array."""
    return reduce(add, terms)


def stacked(parts: Sequence[Array]) -> Array:
    """Arrays along a new first axis; what all runs share is repeated where others are of one."""
    runs = jnp.broadcast_shapes(*(x.shape for x in parts))
    return jnp.stack([jnp.broadcast_to(x, runs) for x in parts])


def stage(fn: Function, *args: Array, batch: int) -> Any:
    """`fn` of arrays with `batch` trailing axes, for use inside a kernel: what other parts of the
    kernel read is computed once."""
    out = _kernel_p.bind(*args, fn=fn, batch=batch)
    return tuple(out) if len(out) > 1 else out[0]


def contiguous(x: Array) -> Array:
    """`x`, its last axis adjacent in memory, which the compiler may see otherwise."""
    return with_layout_constraint(x, Layout(tuple(range(x.ndim))))


def turned(x: Array) -> Array:
    """The transpose of a matrix, as a pass of its own: fused with its neighbours it is slow."""
    return stage(_turned_matrix, x, batch=0)


def _turned_matrix(x: Array) -> Array:
    return contiguous(jnp.swapaxes(x, 0, 1))


_ADJOINTS[_turned_matrix] = _turned_matrix
_APART.add(_turned_matrix)


def turned_rows(x: Array, begin: Array | int, size: int) -> Array:
    """The transpose of `size` rows of a matrix from `begin` on, in one pass."""
    return stage(_turned_rows(size), x, jnp.asarray(begin, jnp.int32), batch=0)


@cache
def _turned_rows(size: int) -> Function:
    def rows(x: Array, begin: Array) -> Array:
        return _turned_matrix(lax.dynamic_slice_in_dim(x, begin.reshape(()), size))

    _APART.add(rows)
    return rows


@kernel
def largest(x: Array) -> Array:
    """The largest of a short vector: a batch of reductions is no vector operation."""
    return reduce(jnp.maximum, x)


@kernel
def smallest(x: Array) -> Array:
    """The smallest of a short vector, likewise."""
    return reduce(jnp.minimum, x)


def _flat_outputs(fn: Function) -> Callable[..., Sequence[Array]]:
    def call(*args: Array) -> Sequence[Array]:
        out = fn(*args)
        return out if isinstance(out, tuple) else (out,)

    return call


@cache
def _jitted_kernel(fn: Function) -> Function:
    def inside(*args: Array) -> Sequence[Array]:
        with set_xla_metadata(inlineable=None):  # meant for the call only
            return _flat_outputs(fn)(*args)

    return jax.jit(inside)


@cache
def _traced_kernel(
    fn: Function, avals: tuple[tuple[tuple[int, ...], DTypeLike], ...]
) -> ClosedJaxpr:
    """`fn` traced, once: the same few kernels come again and again in one program."""
    return jax.make_jaxpr(_flat_outputs(fn))(*(jax.ShapeDtypeStruct(*aval) for aval in avals))


def _kernel_jaxpr(fn: Function, args: Sequence[Array | ShapedArray]) -> ClosedJaxpr:
    return _traced_kernel(fn, tuple((x.shape, x.dtype) for x in args))


def _abstract_outputs(*avals: Any, fn: Function, batch: int) -> Sequence[Any]:
    return [ShapedArray(x.shape, x.dtype) for x in _kernel_jaxpr(fn, avals).out_avals]


def _inline_kernel(*args: Array, fn: Function, batch: int) -> Sequence[Array]:
    return jaxpr_as_fun(_kernel_jaxpr(fn, args))(*args)


def _kernel_apart(*args: Array, fn: Function, batch: int) -> Sequence[Array]:
    if fn in _CHEAP or (batch == 0 and fn not in _APART):
        return _inline_kernel(*args, fn=fn, batch=batch)
    with set_xla_metadata(inlineable="false"):
        return _jitted_kernel(fn)(*args)


def _batch_kernel(
    args: Sequence[Array], dims: Sequence[int | None], *, fn: Function, batch: int
) -> Any:
    runs = next(x.shape[d] for x, d in zip(args, dims, strict=True) if d is not None)
    args = [
        # What all runs share keeps an axis of 1 and is not repeated: a kernel whose inputs are all
        # shared then gives an axis of 1, which says below that its result is shared too.
        x[..., None] if d is None else jnp.moveaxis(x, d, -1)
        for x, d in zip(args, dims, strict=True)
    ]
    out = _kernel_p.bind(*args, fn=fn, batch=batch + 1)
    shared = [x.shape[-1] != runs for x in out]
    out = [x[..., 0] if s else x for x, s in zip(out, shared, strict=True)]
    return out, [None if s else x.ndim - 1 for x, s in zip(out, shared, strict=True)]


# The equation that goes into a derivative is again a kernel, so it is batched and kept apart like
# the first, and derivatives of any order come by the same three rules. Only tangents that move are
# arguments: a zero tangent would be computed with.
def _jvp_kernel(
    primals: Sequence[Array], tangents: Sequence[Any], *, fn: Function, batch: int
) -> Any:
    out = _kernel_p.bind(*primals, fn=fn, batch=batch)
    live = tuple(not isinstance(t, ad.Zero) for t in tangents)
    moved = [t for t in tangents if not isinstance(t, ad.Zero)]
    if fn in _ADJOINTS:
        return out, _kernel_p.bind(*moved, fn=fn, batch=batch)
    return out, _kernel_p.bind(*primals, *moved, fn=_tangent_kernel(fn, live), batch=batch)


@cache
def _tangent_kernel(fn: Function, live: tuple[bool, ...]) -> Function:
    """(primals, tangents of the live ones) -> tangents of the outputs."""

    def tangent(*args: Array) -> tuple[Array, ...]:
        primals, moved = args[: len(live)], args[len(live) :]
        at = [x for x, moves in zip(primals, live, strict=True) if moves]
        # A shared primal (axis of 1) may have a tangent of each run, and the other way round;
        # `jax.jvp` asks for the same shape of both.
        shapes = [jnp.broadcast_shapes(x.shape, t.shape) for x, t in zip(at, moved, strict=True)]
        at, moved = (
            [jnp.broadcast_to(x, s) for x, s in zip(xs, shapes, strict=True)] for xs in (at, moved)
        )

        def outputs(*at: Array) -> tuple[Array, ...]:
            return tuple(_inline_kernel(*_merge_chosen(live, at, primals), fn=fn, batch=0))

        return jax.jvp(outputs, tuple(at), tuple(moved))[1]

    return kept_apart(tangent) if fn in _APART else tangent


# A kernel is transposed only in arguments in which it is linear (tangents of `_jvp_kernel`). The
# transpose depends on which these are and on their shapes without runs, so it is a function of
# both, made once.
def _transpose_kernel(
    cotangents: Sequence[Any], *args: Any, fn: Function, batch: int
) -> Sequence[Any]:
    linear = tuple(ad.is_undefined_primal(x) for x in args)
    unknown = [x.aval for x in args if ad.is_undefined_primal(x)]
    fixed = [x for x in args if not ad.is_undefined_primal(x)]
    given = [ad.instantiate_zeros(ct) for ct in cotangents]
    if fn in _ADJOINTS:
        return _kernel_p.bind(*given, fn=_ADJOINTS[fn], batch=batch)
    inner = tuple((x.shape[: x.ndim - batch], x.dtype) for x in unknown)
    ranks = tuple(x.ndim - batch for x in (*fixed, *given))
    out = _kernel_p.bind(*fixed, *given, fn=_adjoint_kernel(fn, linear, inner, ranks), batch=batch)
    results = iter(_summed_to(x, aval.shape) for x, aval in zip(out, unknown, strict=True))
    return [next(results) if undefined else None for undefined in linear]


@cache
def _adjoint_kernel(
    fn: Function,
    linear: tuple[bool, ...],
    inner: tuple[tuple[tuple[int, ...], DTypeLike], ...],
    ranks: tuple[int, ...],
) -> Function:
    """(arguments with a value, cotangents of the outputs) -> cotangents of the linear arguments."""

    def adjoint(*args: Array) -> tuple[Array, ...]:
        count = linear.count(False)
        fixed, given = args[:count], args[count:]
        runs = jnp.broadcast_shapes(*(x.shape[r:] for x, r in zip(args, ranks, strict=True)))
        unknown = [jax.ShapeDtypeStruct(shape + runs, dtype) for shape, dtype in inner]
        is_fixed = tuple(not x for x in linear)

        def outputs(*xs: Array) -> tuple[Array, ...]:
            every = _merge_chosen(is_fixed, fixed, _merge_chosen(linear, xs, linear))
            return tuple(_inline_kernel(*every, fn=fn, batch=0))

        # Cotangents of what all runs share arrive with an axis of 1; `linear_transpose` wants the
        # shape of the output. What is repeated here is summed again in `_summed_to`.
        given = tuple(
            jnp.broadcast_to(x, x.shape[:r] + runs)
            for x, r in zip(given, ranks[count:], strict=True)
        )
        return jax.linear_transpose(outputs, *unknown)(given)

    return kept_apart(adjoint) if fn in _APART else adjoint


def _merge_chosen(chosen: Sequence[bool], some: Sequence[Any], others: Sequence[Any]) -> list[Any]:
    """`others` with the chosen places taken by `some`, in order."""
    new = iter(some)
    return [next(new) if c else x for c, x in zip(chosen, others, strict=True)]


def _summed_to(x: Array, shape: tuple[int, ...]) -> Array:
    """`x` summed over the axes that `shape` has not, or has as 1."""
    axes = tuple(i for i, (a, b) in enumerate(zip(x.shape, shape, strict=True)) if a != b)
    return jnp.sum(x, axes, keepdims=True) if axes else x


# Only CPUs keep kernels apart: there a fused chain is computed again for every element that reads
# it. Elsewhere a kernel is a part of the program like any other.
_kernel_p = Primitive("kernel")
_kernel_p.multiple_results = True
_kernel_p.def_impl(lambda *args, fn, batch: _jitted_kernel(fn)(*args))
_kernel_p.def_abstract_eval(_abstract_outputs)
mlir.register_lowering(_kernel_p, mlir.lower_fun(_inline_kernel, multiple_results=True))
mlir.register_lowering(
    _kernel_p, mlir.lower_fun(_kernel_apart, multiple_results=True), platform="cpu"
)
batching.primitive_batchers[_kernel_p] = _batch_kernel
ad.primitive_jvps[_kernel_p] = _jvp_kernel
ad.primitive_transposes[_kernel_p] = _transpose_kernel
