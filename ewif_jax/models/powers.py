"""What k equal steps do, composed from what one does.

One step is x -> F x + b + w. Two make F2 F1, F2 b1 + b2 and F2 Q1 F2' + Q2. Of arrays, what
0, 1, ..., 31 steps do and what 0, 32, 64, ... do is written down once, so k steps are two entries.
Of functions of `params`, k steps are a product, over the binary digits of k, of what 1, 2, 4, ...
steps do: 5 = 101 in binary is 1 and 4.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.fast.compiling import array
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.types import Numbers, Parameter, PyTree, Steps

BITS = 5
"""Of k, which one table looks up: few, or the tables of large matrices would be too big."""


class Stride(NamedTuple):
    """What some steps do: F (n, n), and b (n,) and Q (n, n) where they are asked for."""

    F: Any = None
    b: Any = None
    Q: Any = None


def tables_of(one: Stride, steps: Steps) -> list[Stride]:
    """What 0, 1, ..., 31 steps do, what 0, 32, 64, ... do, and so on, stacked, of arrays; made
    once, in float64."""
    still = Stride(*(None if x is None else np.zeros_like(x) for x in one))
    still = still._replace(F=np.eye(len(one.F)))
    tables = []
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(-(-steps.max_steps.bit_length() // BITS)):
            rows = [still, one]
            while len(rows) <= 2**BITS:
                rows.append(both_strides(rows[-1], one, np.matmul, np.matmul))
            one = rows.pop()
            tables.append(jax.tree.map(lambda *x: np.stack(x), *rows))
    return tables


def looked_up(tables: list[Stride], k: Numbers) -> Stride:
    """What k steps do by `tables_of`; of tables of F that have as many rows again for the way back,
    k < 0 too. What was not asked for is left out."""
    total = None
    for number, table in enumerate(tables):
        # k in digits of base 32: each table holds what a digit of its place does, so k steps are
        # one entry of each, composed.
        row = (abs(k) >> (BITS * number)) % 2**BITS
        if len(table.F) > 2**BITS:
            row = row + 2**BITS * (k < 0)
        entry = jax.tree.map(lambda x, row=row: _table_row(array(x), row), table)
        total = entry if total is None else both_strides(total, entry, matmul, matvec)
        total = total._replace(F=total.F if table.b is None and table.Q is None else None)
    assert total is not None
    return total


def _table_row(table: Array, number: Numbers) -> Array:
    return lax.dynamic_index_in_dim(table, number, keepdims=False)


def squares_of(F: Parameter, steps: Steps) -> np.ndarray | None:
    """What F becomes over 1, 2, 4, ... steps, stacked, if it is an array; in float64."""
    if not isinstance(F, np.ndarray):
        return None
    squares = [F]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(steps.max_steps.bit_length() - 1):
            squares.append(squares[-1] @ squares[-1])
    return np.stack(squares)


def power(one: Stride, k: Numbers, steps: Steps, squares: np.ndarray | None = None) -> Stride:
    """What k steps do, nothing if k < 0; `squares` is what is known of F over 1, 2, 4, ... steps.
    An F beside b or Q is left out."""
    still = Stride(*(None if x is None else jnp.zeros_like(x) for x in one))
    still = still._replace(F=jnp.eye(one.F.shape[0], dtype=one.F.dtype))
    total = still if one.b is None and one.Q is None else still._replace(F=None)
    k = chosen_tree(k > 0, k, 0)

    def digit(carry: tuple[Stride, Stride], now: tuple[Any, Any]) -> tuple[Any, None]:
        (total, square), (number, F) = carry, now
        square = square if F is None else square._replace(F=F)
        here = chosen_tree((k >> number) % 2 == 1, square, still)
        # What no digit needs is never squared: it may overflow.
        square = chosen_tree(k >> (number + 1) > 0, square, still)
        square = both_strides(square, square, matmul, matvec)
        if F is not None:
            square = square._replace(F=None)
        return (both_strides(total, here, matmul, matvec), square), None

    # Squares of an F that is an array are known in float64: repeated squaring in float32 would
    # double the relative error at every digit.
    table = None if squares is None else array(squares, one.F.dtype)
    carry = total, one if table is None else one._replace(F=None)
    count = checks.concrete_value(k)
    if count is None:
        numbers = jnp.arange(steps.max_steps.bit_length(), dtype=jnp.int32)
        return lax.scan(digit, carry, (numbers, table))[0][0]
    # A scan that is not part of a program would be compiled anew each time.
    for number in range(int(count).bit_length()):
        carry, _ = digit(carry, (number, None if table is None else table[number]))
    return carry[0]


def both_strides(first: Stride, second: Stride, matmul: Callable, matvec: Callable) -> Stride:
    """What both do, one after the other; the F of the first may be left out."""
    b, Q = None, None
    if first.b is not None and second.b is not None:
        b = matvec(second.F, first.b) + second.b
    if first.Q is not None and second.Q is not None:
        Q = matmul(matmul(second.F, first.Q), second.F.T) + second.Q
    return Stride(None if first.F is None else matmul(second.F, first.F), b, Q)


def chosen_tree(condition: Numbers, first: PyTree, second: PyTree) -> Any:
    """`first` where the condition holds, else `second`."""
    is_concrete = checks.concrete_value(condition)
    if is_concrete is not None:
        return first if is_concrete else second
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), first, second)
