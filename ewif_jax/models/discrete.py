"""Constants as a model in discrete time: what k steps do is composed from what one does.

One step is x -> F x + b + w. Two make F2 F1, F2 b1 + b2 and F2 Q1 F2' + Q2, so k steps are a
product, over the binary digits of k, of what 1, 2, 4, ... steps do: 5 = 101 in binary is 1 and 4.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from ewif_jax import checks
from ewif_jax.fast.compiling import array
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.fast.sparse import Pattern, pattern
from ewif_jax.models.parameters import named, of_params
from ewif_jax.models.steps import count_steps
from ewif_jax.types import Steps

Function = Callable[..., Array]


class Stride(NamedTuple):
    """What some steps do: F (n, n), and b (n,) and Q (n, n) where they are asked for."""

    F: Any = None
    b: Any = None
    Q: Any = None


def is_discrete(value: Any) -> bool:
    """Whether it speaks of one step: an array, or a function of `params` alone."""
    return value is not None and (not callable(value) or of_params(value))


def constant(argument: str, value: Any, expected: tuple[int | str, ...]) -> Any:
    """A discrete F, Q or b as an array of NumPy or a function of `params`; what is refused, is."""
    if callable(value):
        return partial(_read, named(value))
    if isinstance(value, Tracer):
        return lambda params: value
    checks.shape(argument, value, expected)
    checks.finite(argument, value)
    return np.array(value, float)


def _read(value: Function, params: Any) -> Any:
    return value(params)


def full_rank(F: Any) -> bool:
    """Whether a constant F has an inverse; True where that is not known."""
    return not isinstance(F, np.ndarray) or bool(np.linalg.matrix_rank(F) == F.shape[0])


def pattern_of_powers(F: Any) -> Pattern | None:
    """Where any power of a constant F, and so its inverse, may differ from zero."""
    if not isinstance(F, np.ndarray):
        return None
    n = F.shape[0]
    return pattern(np.linalg.matrix_power((F != 0) + np.eye(n), n))


class Motion(NamedTuple):
    """F, Q and b as functions of (params, t0, t1) (Q and b may be None), how time is counted (None:
    any interval is right), and whether F can be asked to go back."""

    F: Function
    Q: Function | None
    b: Function | None
    steps: Steps | None
    reversible: bool


def motion(F: Any, Q: Any, b: Any, steps: Steps) -> Motion:
    """What F, Q and b of one step, or of intervals, say of any interval."""
    for argument, value in (("Q", Q), ("b", b)):
        checks.require(
            is_discrete(F) or not is_discrete(value),
            argument,
            "a function of (params, t0, t1), as F is one: a constant speaks of one step, whose "
            "length such an F does not say",
            "a function of params alone" if callable(value) else "a constant",
        )
    if not is_discrete(F):
        return Motion(F, Q, b, None, True)
    stands = isinstance(F, np.ndarray) and np.array_equal(F, np.eye(F.shape[0]))
    if stands and not is_discrete(Q) and not is_discrete(b):
        return Motion(lambda params, t0, t1: jnp.asarray(F), Q, b, None, True)
    return Motion(
        transition_of_steps(F, steps),
        noise_of_steps(F, Q, steps) if is_discrete(Q) else Q,
        input_of_steps(F, b, steps) if is_discrete(b) else b,
        steps,
        full_rank(F),
    )


def transition_of_steps(F: Any, steps: Steps) -> Function:
    """F^k (n, n) as a function of (params, t0, t1), in either direction."""
    if isinstance(F, np.ndarray):
        return _powers_of_constant(F, steps)

    def matrix(params: Any, t0: Array, t1: Array) -> Array:
        first = _first("F", F, params, ("n", "n"))
        k, whole = count_steps(steps, t0, t1)
        eye = jnp.eye(first.shape[0], dtype=first.dtype)
        # In a batch all branches run: nothing is inverted or multiplied up that is not asked for,
        # or its derivative would be infinity times 0.
        ahead, behind = _chosen(k > 1, first, eye), _chosen(k < 0, first, eye)
        return _switch(
            [
                (k > 1, lambda: _power(Stride(ahead), Stride(), jnp.maximum(k, 0), steps).F),
                (k == -1, lambda: jnp.linalg.inv(behind)),
                (k < -1, lambda: _power(Stride(jnp.linalg.inv(behind)), Stride(), jnp.maximum(-k, 0), steps).F),
            ],
            lambda: _chosen(k > 0, first, _nothing(eye, whole)),
        )

    return matrix


def input_of_steps(F: Any, b: Any, steps: Steps) -> Function:
    """The input (n,) gathered from t0 to t1 >= t0, as a function of (params, t0, t1)."""
    table = _doublings(F, b, None, steps)

    def gathered(params: Any, t0: Array, t1: Array) -> Array:
        first = _first("b", b, params, ("n",))
        k, whole = count_steps(steps, t0, t1)

        def many() -> Array:
            one = Stride(_first("F", F, params, ("n", "n")).astype(first.dtype), b=first)
            return _power(one, table, jnp.maximum(k, 0), steps).b

        return _switch(
            [(k > 1, many)],
            lambda: _chosen(k > 0, first, _nothing(jnp.zeros_like(first), whole)),
        )

    return gathered


def noise_of_steps(F: Any, Q: Any, steps: Steps) -> Function:
    """Q (n, n) from t0 to t1 as a function of (params, t0, t1), zero against time."""
    table = _doublings(F, None, Q, steps)

    def summed(params: Any, t0: Array, t1: Array) -> Array:
        first = _first("Q", Q, params, ("n", "n"))
        k, whole = count_steps(steps, t0, t1)

        def many() -> Array:
            one = Stride(_first("F", F, params, ("n", "n")).astype(first.dtype), Q=first)
            return _power(one, table, jnp.maximum(k, 0), steps).Q

        return _switch(
            [(k > 1, many)],
            lambda: _chosen(k > 0, first, _nothing(jnp.zeros_like(first), whole)),
        )

    return summed


def _powers_of_constant(F: np.ndarray, steps: Steps) -> Function:
    back = np.linalg.inv(F) if full_rank(F) else np.full(F.shape, np.nan)
    ahead, behind = (_doublings(one, None, None, steps).F for one in (F, back))

    def matrix(params: Any, t0: Array, t1: Array) -> Array:
        del params
        k, whole = count_steps(steps, t0, t1)
        eye = jnp.eye(F.shape[0])

        def many() -> Array:
            table = Stride(_chosen(k < 0, array(behind), array(ahead)))
            return _power(Stride(eye), table, abs(k), steps).F

        def single() -> Array:
            step = _chosen(k < 0, array(back), array(F))
            return _chosen(k == 0, _nothing(eye, whole), step)

        return _switch([(abs(k) > 1, many)], single)

    return matrix


def _doublings(F: Any, b: Any, Q: Any, steps: Steps) -> Stride:
    """What 1, 2, 4, ... steps do, of what are arrays, stacked; made once, in float64."""
    if not isinstance(F, np.ndarray):
        return Stride()
    b, Q = (x if isinstance(x, np.ndarray) else None for x in (b, Q))
    table = [Stride(F, b, Q)]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(steps.max_steps.bit_length() - 1):
            table.append(then(table[-1], table[-1], np.matmul, np.matmul))
    return Stride(*(None if x[0] is None else np.stack(x) for x in zip(*table, strict=True)))


def _power(one: Stride, table: Stride, k: Array, steps: Steps) -> Stride:
    """What k >= 0 steps do; `table` holds what is known of 1, 2, 4, ... steps, stacked."""
    still = Stride(*(None if x is None else jnp.zeros_like(x) for x in one))
    still = still._replace(F=jnp.eye(one.F.shape[0], dtype=one.F.dtype))
    table = Stride(
        *(None if x is None or y is None else array(x, y.dtype) for x, y in zip(table, one))
    )
    free = Stride(*(x if y is None else None for x, y in zip(one, table, strict=True)))

    def digit(carry: tuple[Stride, Stride], now: tuple[Array, Stride]) -> tuple[Any, None]:
        (total, free), (number, looked_up) = carry, now
        square = _either(looked_up, free)
        total = then(total, _chosen((k >> number) % 2 == 1, square, still), matmul, matvec)
        if any(x is not None for x in free):
            # What no digit needs is never squared: it may overflow.
            square = _chosen(k >> (number + 1) > 0, square, still)
            square = then(square, square, matmul, matvec)
            free = Stride(
                *(None if x is None else y for x, y in zip(free, square, strict=True))
            )
        return (total, free), None

    start = still if one.b is None and one.Q is None else still._replace(F=None)
    count = checks.known(k)
    if count is None:
        numbers = jnp.arange(steps.max_steps.bit_length(), dtype=jnp.int32)
        return lax.scan(digit, (start, free), (numbers, table))[0][0]
    carry = (start, free)
    for number in range(int(count).bit_length()):
        carry, _ = digit(carry, (number, jax.tree.map(lambda x, n=number: x[n], table)))
    return carry[0]


def _either(first: Stride, second: Stride) -> Stride:
    return Stride(*(y if x is None else x for x, y in zip(first, second, strict=True)))


def then(first: Stride, second: Stride, matmul: Function, matvec: Function) -> Stride:
    """What both do, one after the other; the F of the first may be left out."""
    b, Q = None, None
    if first.b is not None and second.b is not None:
        b = matvec(second.F, first.b) + second.b
    if first.Q is not None and second.Q is not None:
        Q = matmul(matmul(second.F, first.Q), second.F.T) + second.Q
    return Stride(None if first.F is None else matmul(second.F, first.F), b, Q)


def _chosen(condition: Any, first: Any, second: Any) -> Any:
    """`first` where the condition holds, else `second`."""
    is_concrete = checks.known(condition)
    if is_concrete is not None:
        return first if is_concrete else second
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), first, second)


def _nothing(still: Array, whole: Any) -> Array:
    """What no step does; NaN where the steps are not whole."""
    return _chosen(whole, still, jnp.full_like(still, jnp.nan))


def _first(argument: str, value: Any, params: Any, expected: tuple[int | str, ...]) -> Array:
    """What a discrete F, Q or b is for one step."""
    made = jnp.asarray(value(params) if callable(value) else value)
    checks.shape(argument, made, expected)
    return made if jnp.issubdtype(made.dtype, jnp.floating) else made.astype(float)


def _switch(
    cases: list[tuple[Array, Callable[[], Array]]], otherwise: Callable[[], Array]
) -> Array:
    """The value of the first case whose condition holds, else `otherwise`; only that is computed,
    unless the conditions differ in a batch."""
    if all(checks.known(condition) is not None for condition, _ in cases):
        return next((make for condition, make in cases if condition), otherwise)()
    index = jnp.zeros((), jnp.int32)
    for number, (condition, _) in enumerate(cases, 1):
        index = jnp.where(condition, jnp.int32(number), index)
    return lax.switch(index, [otherwise, *(make for _, make in cases)])
