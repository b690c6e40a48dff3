"""Matrices that differ from sensor to sensor: what a table of them must be, and one looked up."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from ewif_jax import checks
from ewif_jax.fast.compiling import array, one_program
from ewif_jax.fast.small import matvec
from ewif_jax.fast.sparse import Pattern, pattern
from ewif_jax.models.parameters import named, of_params
from ewif_jax.types import Numbers, Parameter, Params


def by_sensor(argument: str, x: Numbers) -> tuple[Any, int | None]:
    """A function of (params, sensor, t), and how many sensors it knows of: S of a table, 0 for a
    matrix that all sensors share, None for a function."""
    if isinstance(x, Tracer):
        return partial(_looked_up, argument, lambda params: x), None
    if callable(x):
        seen = named(one_program(x) if argument == "R" else x)  # R is looked at before tracing
        return (partial(_looked_up, argument, seen) if of_params(x) else seen), None
    table = array(x)
    checks.finite(argument, x)
    checks.require(
        table.ndim in (2, 3), argument, "a function, a matrix or a table (S, ., .)", table.shape
    )
    if argument == "R":
        for k, matrix in enumerate(np.asarray(x) if table.ndim == 3 else [x]):
            checks.psd("R" if table.ndim == 2 else f"R[{k}]", matrix)
    if table.ndim == 2:
        return (lambda params, sensor, t: table), 0
    matrices = np.asarray(x, table.dtype)

    def chosen(params: Params, sensor: Numbers, t: Array) -> Any:
        del params, t
        is_number = isinstance(sensor, int | np.integer)
        return matrices[min(sensor, len(matrices) - 1)] if is_number else select(table, sensor)

    return chosen, table.shape[0]


def of_sizes(
    argument: str, x: Numbers, pad: Callable[[Any, int], Any]
) -> tuple[Any, tuple[int, ...] | None]:
    """`x`, of a list of matrices with different numbers of rows a table as high as the highest, and
    these numbers; None where they do not differ."""
    if not isinstance(x, list | tuple) or any(np.ndim(matrix) != 2 for matrix in x):
        return x, None
    sizes = different([np.shape(matrix)[0] for matrix in x])
    if sizes is None:
        return x, None
    for k, matrix in enumerate(x):
        checks.finite(f"{argument}[{k}]", matrix)
    same = len({np.shape(pad(matrix, max(sizes)))[1] for matrix in map(np.asarray, x)}) == 1
    expected = "matrices with equally many columns" if argument == "H" else "square matrices"
    checks.require(same, argument, expected, [np.shape(matrix) for matrix in x])
    return np.stack([pad(np.asarray(matrix, float), max(sizes)) for matrix in x]), sizes


def same_sizes(
    rows: tuple[int, ...] | None, cols: tuple[int, ...] | None
) -> tuple[int, ...] | None:
    """How many components each sensor has by H and R of `of_sizes`."""
    both = rows is not None and cols is not None
    checks.require(not both or rows == cols, "R", f"as many components as H has, {rows}", f"{cols}")
    return cols if rows is None else rows


def different(sizes: Sequence[int]) -> tuple[int, ...] | None:
    """`sizes`, or None where all are equal."""
    return tuple(sizes) if len(set(sizes)) > 1 else None


def wider(x: Numbers, m: int) -> Any:
    """x (k, ...) with zeros up to (m, ...)."""
    k = np.shape(x)[0]
    if k == m:
        return x
    xp = jnp if isinstance(x, Array) else np
    return xp.concatenate([x, xp.zeros((m - k, *np.shape(x)[1:]), x.dtype)])


def wider_cov(cov: Numbers, m: int) -> Any:
    """A covariance (k, k) with independent components of unit variance up to (m, m)."""
    k = np.shape(cov)[0]
    if k == m:
        return cov
    xp = jnp if isinstance(cov, Array) else np
    inside = np.arange(m) < k
    padded = xp.pad(cov, (0, m - k))
    return xp.where(inside[:, None] & inside, padded, np.eye(m, dtype=padded.dtype))


def _looked_up(argument: str, x: Numbers, params: Params, sensor: Array, t: Array) -> Array:
    """The matrix of a sensor in what `params` give: a matrix, or a table of them."""
    del t
    table = jnp.asarray(x(params))
    checks.require(
        table.ndim in (2, 3), argument, "a matrix or a table (S, ., .) from params", table.shape
    )
    return table if table.ndim == 2 else table[sensor]


def count_sensors(rows: int | None, cols: int | None) -> int | None:
    """How many sensors H and R speak of together; one matrix each is one sensor."""
    tables = [count for count in (rows, cols) if count]
    checks.require(
        len(set(tables)) < 2, "R", f"as many sensors as H has ({rows})", f"{cols} sensors"
    )
    return tables[0] if tables else 1 if rows == cols == 0 else None


def pattern_of_table(H: Parameter) -> Pattern | None:
    """Where a constant matrix, or any of a table, may differ from zero."""
    values = None if callable(H) else checks.concrete_value(H)
    return None if values is None else pattern(*values.reshape(-1, *values.shape[-2:]))


def select(table: Array, index: Array) -> Array:
    """table[index] for a small table, as a product (a gather is slow in a batch)."""
    chosen = (jnp.arange(table.shape[0]) == index).astype(table.dtype)
    return matvec(table.reshape(table.shape[0], -1).T, chosen).reshape(table.shape[1:])
