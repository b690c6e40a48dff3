"""Known inputs as data: piecewise constant, integrated exactly over any interval."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks, plain
from ewif_jax.fast.small import matvec
from ewif_jax.models.parameters import resolve
from ewif_jax.types import DTypeLike, Numbers, Parameter, Params

Outside = Literal["hold", "nan"]
OfInterval = Callable[..., Array]


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Inputs:
    """An input of k numbers: values (K, k), each from times (K,) on. A pytree: it may travel in
    `params`, with a leading axis of runs too."""

    times: Array
    values: Array
    outside: Outside = field(default="hold", metadata={"static": True})
    most: int | None = field(default=None, metadata={"static": True})


class Pieces(NamedTuple):
    """An interval cut where the input changes: start (P,), end (P,), value (P, k); pieces of no
    length where there are fewer. is_given (): whether the input is, over all of the interval."""

    start: Array
    end: Array
    value: Array
    is_given: Array


def inputs(
    times: Numbers, values: Numbers, *, outside: Outside = "hold", most: int | None = None
) -> Inputs:
    r"""A known input as data: values[k] holds from times[k] until times[k + 1].

    For `linear_model(..., B=, u=)`, `models.from_continuous(..., B=, u=)` and the `u` of kinematic
    models. They integrate it exactly over any interval, cut at the input's own times:

    .. math::
        c(t_0, t_1) = \sum_k F(e_k, t_1)\, B(s_k, e_k)\, u_k

    over the pieces :math:`[s_k, e_k]` of the interval; also backwards, for late data.

    Args:
        times: (K,) seconds, increasing, counted as the measurements' are.
        values: (K, k), or (K,) for one number.
        outside: before the first time and after the last. "hold": the first and the last value go
            on. "nan": the input is not known there, and what would need it is NaN; the last row
            then only says how long the one before it holds.
        most: how many pieces one interval may have. Every interval costs as much as `most` pieces,
            by default all K. Where there are more, the result is NaN.

    Returns:
        `Inputs`, a pytree. It may be an argument, be made inside a traced function, and travel in
        `params`: derivatives in the values, and in the times, are those of the exact integral.

    Raises:
        ValueError: times that do not increase or are not finite, values of another length or not
            finite, an unknown `outside`, `most` < 1.
    """
    times, values = plain.numbers("times", times), plain.numbers("values", values)
    checks.shape("times", times, ("K",))
    count = np.shape(times)[0]
    checks.require(count > 0, "times", "at least one", "none")
    values = values[:, None] if np.ndim(values) == 1 else values
    checks.shape("values", values, (count, "k"))
    checks.finite("times", times)
    checks.finite("values", values)
    stamps = checks.concrete_value(times)
    if stamps is not None:
        back = np.flatnonzero(np.diff(stamps) <= 0)
        at = int(back[0]) if back.size else 0
        got = f"{stamps[at + 1]} after {stamps[at]}" if back.size else ""
        checks.require(not back.size, "times", "times that increase", got)
    checks.require(outside in ("hold", "nan"), "outside", "'hold' or 'nan'", repr(outside))
    most = None if most is None else checks.whole("most", most, 1)
    return Inputs(times, values, outside, most)


def pieces_of(given: Inputs, t0: Array, t1: Array, dtype: DTypeLike) -> Pieces:
    """The interval from t0 to t1 >= t0 in pieces."""
    times, values = jnp.asarray(given.times, dtype), jnp.asarray(given.values, dtype)
    # The first value holds before its time too, the last has no end.
    starts = jnp.concatenate([jnp.full(1, -jnp.inf, dtype), times[1:]])
    ends = jnp.concatenate([times[1:], jnp.full(1, jnp.inf, dtype)])
    is_given = jnp.asarray(True)
    if given.outside == "nan":
        is_given = (t0 >= times[0]) & (t1 <= times[-1])
    count = times.shape[0]
    if given.most is not None and given.most < count:
        first = jnp.sum(ends <= t0)
        first = jnp.minimum(first, count - given.most)
        starts, ends, values = (
            lax.dynamic_slice_in_dim(x, first, given.most) for x in (starts, ends, values)
        )
        is_given &= t1 <= ends[-1]
    start, end = (_inside(x, t0, t1) for x in (starts, ends))
    return Pieces(start, end, values, is_given | (t1 == t0))


def _inside(times: Array, t0: Array, t1: Array) -> Array:
    """The times, moved into the interval."""
    # Not `clip`, which shares the derivative between equal times: at t0 = t1 that in t1 is the
    # input's rate.
    return jnp.where(times > t0, jnp.where(times < t1, times, t1), t0)


def driven(F: OfInterval, B: OfInterval, u: Parameter, b: OfInterval | None) -> OfInterval:
    """The input (n,) gathered from t0 to t1 >= t0, as a function of (params, t0, t1).

    Args:
        F: (params, t0, t1) -> (n, n).
        B: (params, t0, t1) -> (n, k), the effect of a constant unit input over an interval.
        u: `Inputs`, or a function of `params` that gives one.
        b: what else is gathered, or None.
    """
    if not callable(u):
        need_inputs(u)

    def gathered(params: Params, t0: Array, t1: Array) -> Array:
        given = resolve(u, params)
        need_inputs(given)
        dtype = jnp.result_type(t0, t1, 0.0)
        start, end, value, is_given = pieces_of(given, t0, t1, dtype)

        def pushed(start: Array, end: Array, value: Array) -> Array:
            response = jnp.asarray(B(params, start, end))
            checks.shape("u.values", given.values, ("K", response.shape[1]))
            rest = jnp.asarray(F(params, end, t1), response.dtype)
            return matvec(rest, matvec(response, value.astype(response.dtype)))

        total = jnp.sum(jax.vmap(pushed)(start, end, value), 0)
        total = jnp.where(is_given, total, jnp.nan)
        return total if b is None else total + jnp.asarray(b(params, t0, t1), total.dtype)

    return gathered


def need_inputs(u: Parameter) -> None:
    """Refuses what is no `Inputs`."""
    expected = "inputs(times, values), or a function of params that gives them"
    checks.require(isinstance(u, Inputs), "u", expected, f"a {type(u).__name__}")


def need_both(B: Parameter, u: Parameter) -> None:
    """Refuses B without u, and u without B."""
    checks.require(u is not None or B is None, "u", "the input that B is for, inputs(...)", None)
    checks.require(B is not None or u is None, "B", "what the input u does to the state", None)
