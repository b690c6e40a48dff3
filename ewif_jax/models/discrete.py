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
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.fast.sparse import Pattern, pattern
from ewif_jax.models.parameters import named, of_params
from ewif_jax.models.steps import count_steps
from ewif_jax.types import Steps

Function = Callable[..., Array]


class Stride(NamedTuple):
    """What some steps do: F (n, n), and b (n,) and Q (n, n) where they are asked for."""

    F: Any
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
        ahead, behind = jnp.where(k > 1, first, eye), jnp.where(k < 0, first, eye)
        return _switch(
            [
                (k > 1, lambda: _power(Stride(ahead), [], jnp.maximum(k, 0), steps).F),
                (k == -1, lambda: jnp.linalg.inv(behind)),
                (
                    k < -1,
                    lambda: _power(Stride(jnp.linalg.inv(behind)), [], jnp.maximum(-k, 0), steps).F,
                ),
            ],
            lambda: jnp.where(k > 0, first, _nothing(eye, whole)),
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

        nothing = _nothing(jnp.zeros_like(first), whole)
        return _switch([(k > 1, many)], lambda: jnp.where(k > 0, first, nothing))

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

        nothing = _nothing(jnp.zeros_like(first), whole)
        return _switch([(k > 1, many)], lambda: jnp.where(k > 0, first, nothing))

    return summed


def _powers_of_constant(F: np.ndarray, steps: Steps) -> Function:
    back = np.linalg.inv(F) if full_rank(F) else np.full(F.shape, np.nan)
    ahead = [one.F for one in _doublings(F, None, None, steps)]
    behind = [one.F for one in _doublings(back, None, None, steps)]

    def matrix(params: Any, t0: Array, t1: Array) -> Array:
        del params
        k, whole = count_steps(steps, t0, t1)
        still = _nothing(jnp.eye(F.shape[0]), whole)

        def many() -> Array:
            table = [
                Stride(jnp.where(k < 0, jnp.asarray(b), jnp.asarray(a)))
                for a, b in zip(ahead, behind, strict=True)
            ]
            return _power(table[0], table, abs(k), steps).F

        def single() -> Array:
            return jnp.where(k > 0, jnp.asarray(F), jnp.where(k < 0, jnp.asarray(back), still))

        return _switch([(abs(k) > 1, many)], single)

    return matrix


def _doublings(F: Any, b: Any, Q: Any, steps: Steps) -> list[Stride]:
    """What 1, 2, 4, ... steps do, of what are arrays; made once, in float64."""
    if not isinstance(F, np.ndarray):
        return []
    b, Q = (x if isinstance(x, np.ndarray) else None for x in (b, Q))
    table = [Stride(F, b, Q)]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(steps.max_steps.bit_length() - 1):
            table.append(_then(table[-1], table[-1], np.matmul, np.matmul))
    return table


def _power(one: Stride, table: list[Stride], k: Array, steps: Steps) -> Stride:
    """What k >= 0 steps do; `table` holds what is known of 1, 2, 4, ... steps."""
    zero = Stride(*(None if x is None else jnp.zeros_like(x) for x in one))
    still = zero._replace(F=jnp.eye(one.F.shape[0], dtype=one.F.dtype))
    total, square = still, one
    for digit in range(steps.max_steps.bit_length()):
        if digit:
            # What no digit needs is never squared: it may overflow.
            square = _chosen(k >> digit > 0, square, still)
            square = _then(square, square, matmul, matvec)
        if table:
            known = zip(table[digit], square, strict=True)
            square = Stride(
                *(y if x is None or y is None else jnp.asarray(x, y.dtype) for x, y in known)
            )
        total = _then(total, _chosen((k >> digit) % 2 == 1, square, still), matmul, matvec)
    return total


def _then(first: Stride, second: Stride, matmul: Function, matvec: Function) -> Stride:
    """Both, one after the other."""
    b, Q = None, None
    if first.b is not None and second.b is not None:
        b = matvec(second.F, first.b) + second.b
    if first.Q is not None and second.Q is not None:
        Q = matmul(matmul(second.F, first.Q), second.F.T) + second.Q
    return Stride(matmul(second.F, first.F), b, Q)


def _chosen(condition: Array, stride: Stride, still: Stride) -> Stride:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), stride, still)


def _nothing(still: Array, whole: Array) -> Array:
    """What no step does; NaN where the steps are not whole."""
    return jnp.where(whole, still, jnp.asarray(jnp.nan, still.dtype))


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
