"""Ordinary arrays of numbers from what people have: other byte orders, lists, columns of tables."""

from numbers import Real
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import keystr, tree_map_with_path

from ewif_jax import checks
from ewif_jax.checks import Shown, require
from ewif_jax.types import DTypeLike, Numbers, Params


def native(x: Numbers) -> Any:
    """`x` in the byte order of this machine: JAX reads the bytes of any other array as they lie."""
    if isinstance(x, np.ndarray | np.generic) and not x.dtype.isnative:
        return x.astype(x.dtype.newbyteorder("="))
    return x


def in_dtype(x: Numbers, dtype: DTypeLike) -> Any:
    """`x` in `dtype`, its value known as before."""
    value = checks.concrete_value(x)
    return jnp.asarray(x, dtype) if value is None else value.astype(dtype)


def numbers(argument: str, x: Numbers, missing: bool = False) -> Any:
    """`x` as an array of real numbers: an array of JAX as it is, all else as NumPy's, whole numbers
    as float64 (JAX would cut them to 32 bits).

    Args:
        argument: its name in messages.
        x: arrays, lists, columns of tables.
        missing: whether None may stand for what is missing: it becomes NaN.

    Raises:
        ValueError: complex numbers, words, booleans, date-times, masked elements.
    """
    if isinstance(x, Array):
        require(_real_dtype(x.dtype), argument, "real numbers", x.dtype)
        return x
    require_unmasked(argument, x)
    value = checks.from_rows(argument, x)
    if value.dtype.kind == "O":
        good = (Real, type(None)) if missing else Real
        strangers = [e for e in value.ravel() if not isinstance(e, good) or isinstance(e, bool)]
        require(not strangers, argument, "real numbers", Shown(next(iter(strangers), None)))
        return value.astype(float)
    require(
        _real_dtype(value.dtype), argument, "real numbers", value.dtype if value.ndim else Shown(x)
    )
    longer = value.dtype.kind in "iu" or value.dtype == np.longdouble
    return value.astype(float) if longer else native(value)


def equal_rows(argument: str, x: Numbers, filler: Numbers) -> Any:
    """Of a list of arrays (lists, numbers) of different lengths an array (T, longest), filled up;
    anything else as it is."""
    if not isinstance(x, list | tuple) or not all(map(_is_flat, x)):
        return x
    longest = max(map(np.size, x), default=0)
    if all(np.size(row) == longest for row in x):
        return x
    rows = []
    for row in x:
        if isinstance(row, np.ma.MaskedArray):
            row = np.ma.filled(row.astype(float), np.nan)
        xp = jnp if isinstance(row, Array) else np
        row = xp.atleast_1d(row if isinstance(row, Array) else checks.from_rows(argument, row))
        dtype = xp.result_type(row.dtype, filler)
        fill = xp.full(longest - row.size, filler, dtype)
        rows.append(xp.concatenate([row.astype(dtype), fill]))
    return (jnp if any(isinstance(row, Array) for row in rows) else np).stack(rows)


def _is_flat(row: Numbers) -> bool:
    """Whether it is a number, or one axis of numbers."""
    if isinstance(row, list | tuple):
        return not any(isinstance(one, list | tuple) or np.ndim(one) for one in row)
    return np.ndim(row) < 2


def indices(argument: str, x: Numbers) -> Any:
    """`x` as int32 indices, NumPy's unless it is an array of JAX.

    Raises:
        ValueError: fractions, negative numbers, numbers beyond int32, what is not a number.
    """
    if isinstance(x, Array):
        require(jnp.issubdtype(x.dtype, jnp.integer), argument, "whole numbers", x.dtype)
    value = checks.concrete_value(x if isinstance(x, Array) else checks.from_rows(argument, x))
    if value is None:
        return x.astype(np.int32)
    value = value if value.dtype.kind in "iu" else numbers(argument, x)
    whole = np.isfinite(value) & (value == np.floor(value))
    require(whole.all(), argument, "whole numbers", Shown(_first_bad_value(value, ~whole)))
    inside = (value >= 0) & (value <= np.iinfo(np.int32).max)
    expected = "indices >= 0 that fit into int32"
    require(inside.all(), argument, expected, Shown(_first_bad_value(value, ~inside)))
    return x.astype(np.int32) if isinstance(x, Array) else value.astype(np.int32)


def booleans(argument: str, x: Numbers) -> Any:
    """`x` as booleans, NumPy's unless it is an array of JAX; whole numbers 0 and 1 will do.

    Raises:
        ValueError: words, fractions, NaN, other numbers.
    """
    if isinstance(x, Array):
        require(x.dtype == bool, argument, "booleans", x.dtype)
        return x
    require_unmasked(argument, x)
    value = checks.from_rows(argument, x)
    if value.dtype.kind == "O":
        strangers = [e for e in value.ravel() if not isinstance(e, bool | np.bool_)]
        require(not strangers, argument, "booleans", Shown(next(iter(strangers), None)))
    elif value.dtype != bool:
        require(value.dtype.kind in "iu", argument, "booleans", value.dtype)
        odd = (value != 0) & (value != 1)
        require(
            not odd.any(), argument, "booleans (or 0 and 1)", Shown(_first_bad_value(value, odd))
        )
    return value.astype(bool)


def parameters(params: Params) -> Any:
    """`params` with every array that is not one of JAX as NumPy has it, in native byte order.

    Raises:
        ValueError: a leaf of words, date-times, objects or masked elements, by its name.
    """
    return tree_map_with_path(_parameter_leaf, params)


def _parameter_leaf(path: Any, x: Numbers) -> Any:
    if isinstance(x, Array | float | int):
        return x
    require_unmasked(f"params{keystr(path)}", x)
    value = checks.from_rows(f"params{keystr(path)}", x)
    good = value.dtype.kind not in "OUSMm"
    require(good, f"params{keystr(path)}", "numbers", Shown(x))
    narrow = value.dtype.kind in "iu" and not jax.config.jax_enable_x64  # pyright: ignore
    if narrow and value.size:
        largest = max(abs(int(value.max())), abs(int(value.min())))
        fits = largest <= np.iinfo(np.int32).max
        require(fits, f"params{keystr(path)}", "whole numbers that fit into int32", largest)
    return native(value)


def require_unmasked(argument: str, x: Numbers) -> None:
    """Refuses a masked array with something masked in it."""
    hidden = isinstance(x, np.ma.MaskedArray) and np.ma.is_masked(x)
    require(
        not hidden,
        argument,
        "an array without masked elements (`stream` takes masked values and masks them)",
        "a masked array",
    )


def _real_dtype(dtype: DTypeLike) -> bool:
    return jnp.issubdtype(dtype, jnp.integer) or jnp.issubdtype(dtype, jnp.floating)


def _first_bad_value(value: np.ndarray, bad: np.ndarray) -> Any:
    return value[bad].flat[0].item() if bad.any() else None
