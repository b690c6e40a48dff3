"""Constants as a model in discrete time: one step is x -> F x + b + w."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from ewif_jax import checks
from ewif_jax.fast.compiling import array, one_program
from ewif_jax.fast.sparse import Pattern, pattern
from ewif_jax.models.parameters import named, of_params
from ewif_jax.models.powers import Stride, chosen_tree, looked_up, power, squares_of, tables_of
from ewif_jax.models.steps import count_steps
from ewif_jax.types import Numbers, Parameter, Params, Steps

Function = Callable[..., Array]


def is_discrete(value: Numbers) -> bool:
    """Whether it speaks of one step: an array, or a function of `params` alone."""
    return value is not None and (not callable(value) or of_params(value))


def constant(argument: str, value: Numbers, expected: tuple[int | str, ...]) -> Any:
    """A discrete F, Q or b as an array of NumPy or a function of `params`; what is refused, is."""
    if callable(value):
        return partial(_read_matrix, named(one_program(value)))
    if isinstance(value, Tracer):
        return lambda params: value
    checks.shape(argument, value, expected)
    checks.finite(argument, value)
    return np.array(value, float)


def _read_matrix(value: Function, params: Params) -> Any:
    return value(params)


def full_rank(F: Parameter) -> bool:
    """Whether a constant F has an inverse; True where that is not known."""
    return not isinstance(F, np.ndarray) or bool(np.linalg.matrix_rank(F) == F.shape[0])


def pattern_of_powers(F: Parameter) -> Pattern | None:
    """Where any power of a constant F, and so its inverse, may differ from zero."""
    if not isinstance(F, np.ndarray):
        return None
    n = F.shape[0]
    # Of the graph of F with loops, walks of n steps reach whatever any number of steps reaches; the
    # inverse is a polynomial in F (Cayley and Hamilton), so it has no other elements.
    return pattern(np.linalg.matrix_power((F != 0) + np.eye(n), n))


class Motion(NamedTuple):
    """F, Q, b and B as functions of (params, t0, t1) (all but F may be None), how time is counted
    (None: any interval is right), and whether F can be asked to go back."""

    F: Function
    Q: Function | None
    b: Function | None
    B: Function | None
    steps: Steps | None
    reversible: bool


def motion(F: Parameter, Q: Parameter, b: Parameter, B: Parameter, steps: Steps) -> Motion:
    """What F, Q, b and B of one step, or of intervals, say of any interval."""
    for argument, value in (("Q", Q), ("b", b), ("B", B)):
        checks.require(
            is_discrete(F) or not is_discrete(value),
            argument,
            "a function of (params, t0, t1), as F is one: a constant speaks of one step, whose "
            "length such an F does not say",
            "a function of params alone" if callable(value) else "a constant",
        )
    if not is_discrete(F):
        return Motion(F, Q, b, B, None, True)
    stands = isinstance(F, np.ndarray) and np.array_equal(F, np.eye(F.shape[0]))
    if stands and not any(map(is_discrete, (Q, b, B))):
        return Motion(lambda params, t0, t1: jnp.asarray(F), Q, b, B, None, True)
    return Motion(
        transition_of_steps(F, steps),
        noise_of_steps(F, Q, steps) if is_discrete(Q) else Q,
        input_of_steps(F, b, steps) if is_discrete(b) else b,
        response_of_steps(F, B, steps) if is_discrete(B) else B,
        steps,
        full_rank(F),
    )


def transition_of_steps(F: Parameter, steps: Steps) -> Function:
    """F^k (n, n) as a function of (params, t0, t1), in either direction."""
    if isinstance(F, np.ndarray):
        return _powers_of_constant(F, steps)

    def matrix(params: Params, t0: Array, t1: Array) -> Array:
        first = _first_step("F", F, params, ("n", "n"))
        k, whole = count_steps(steps, t0, t1)
        eye = jnp.eye(first.shape[0], dtype=first.dtype)
        # In a batch all branches run: nothing is inverted or multiplied up that is not asked for,
        # or its derivative would be infinity times 0.
        ahead, behind = chosen_tree(k > 1, first, eye), chosen_tree(k < 0, first, eye)
        return _first_case(
            [
                (k > 1, lambda: power(Stride(ahead), k, steps).F),
                (k == -1, lambda: _inverse_motion(behind)),
                (k < -1, lambda: _motion_back(behind, -k, steps)),
            ],
            lambda: chosen_tree(k > 0, first, _no_change(eye, whole)),
        )

    return matrix


def _inverse_motion(F: Array) -> Array:
    """F^-1 (n, n), NaN where F is singular to rounding: the inverse is then some large numbers."""
    inverse = jnp.linalg.inv(F)
    size, size_back = (jnp.max(jnp.sum(jnp.abs(x), 1)) for x in (F, inverse))
    good = size * size_back * F.shape[0] * jnp.finfo(F.dtype).eps < 1  # the condition number
    return jnp.where(good, inverse, jnp.nan)


def _motion_back(F: Array, k: Array, steps: Steps) -> Array:
    """F^-k (n, n): NaN where F is singular, infinite where it only grows too large."""
    inverse = _inverse_motion(F)
    far = power(Stride(inverse), k, steps).F
    usable = jnp.all(jnp.isfinite(far)) | jnp.any(jnp.isnan(inverse))
    return jnp.where(usable, far, jnp.inf)


def input_of_steps(F: Parameter, b: Parameter, steps: Steps) -> Function:
    """The input (n,) gathered from t0 to t1 >= t0, as a function of (params, t0, t1)."""
    is_table = isinstance(F, np.ndarray) and isinstance(b, np.ndarray)
    tables = tables_of(Stride(F, b=b), steps) if is_table else []
    squares = squares_of(F, steps)

    def gathered(params: Params, t0: Array, t1: Array) -> Array:
        first = _first_step("b", b, params, ("n",))
        k, whole = count_steps(steps, t0, t1)

        def many() -> Array:
            if tables:
                return looked_up(tables, k).b
            one = Stride(_first_step("F", F, params, ("n", "n")).astype(first.dtype), b=first)
            return power(one, k, steps, squares).b

        return _first_case(
            [(k > 1, many)],
            lambda: chosen_tree(k > 0, first, _no_change(jnp.zeros_like(first), whole)),
        )

    return gathered


def response_of_steps(F: Parameter, B: Parameter, steps: Steps) -> Function:
    """What a constant unit input does from t0 to t1 >= t0 (n, k), as a function of (params, t0,
    t1)."""
    if isinstance(B, np.ndarray):
        columns = [input_of_steps(F, column, steps) for column in B.T]

        def known(params: Params, t0: Array, t1: Array) -> Array:
            return jnp.stack([column(params, t0, t1) for column in columns], 1)

        return known

    def read(params: Params, t0: Array, t1: Array) -> Array:
        first = _first_step("B", B, params, ("n", "k"))
        columns = [input_of_steps(F, partial(_same_column, x), steps) for x in first.T]
        return jnp.stack([column(params, t0, t1) for column in columns], 1)

    return read


def _same_column(column: Array, params: Params) -> Array:
    del params
    return column


def noise_of_steps(F: Parameter, Q: Parameter, steps: Steps) -> Function:
    """Q (n, n) from t0 to t1 as a function of (params, t0, t1), zero against time."""
    is_table = isinstance(F, np.ndarray) and isinstance(Q, np.ndarray)
    tables = tables_of(Stride(F, Q=Q), steps) if is_table else []
    squares = squares_of(F, steps)

    def summed(params: Params, t0: Array, t1: Array) -> Array:
        first = _first_step("Q", Q, params, ("n", "n"))
        k, whole = count_steps(steps, t0, t1)

        def many() -> Array:
            if tables:
                return looked_up(tables, k).Q
            one = Stride(_first_step("F", F, params, ("n", "n")).astype(first.dtype), Q=first)
            return power(one, k, steps, squares).Q

        return _first_case(
            [(k > 1, many)],
            lambda: chosen_tree(k > 0, first, _no_change(jnp.zeros_like(first), whole)),
        )

    return summed


def _powers_of_constant(F: np.ndarray, steps: Steps) -> Function:
    back = np.linalg.inv(F) if full_rank(F) else np.full(F.shape, np.nan)
    tables = [
        Stride(np.concatenate([ahead.F, behind.F]))
        for ahead, behind in zip(
            tables_of(Stride(F), steps), tables_of(Stride(back), steps), strict=True
        )
    ]

    def matrix(params: Params, t0: Array, t1: Array) -> Array:
        del params
        k, whole = count_steps(steps, t0, t1)

        def single() -> Array:
            step = chosen_tree(k < 0, array(back), array(F))
            return chosen_tree(k == 0, _no_change(jnp.eye(F.shape[0]), whole), step)

        return _first_case([(abs(k) > 1, lambda: looked_up(tables, k).F)], single)

    return matrix


def _no_change(still: Array, whole: Numbers) -> Array:
    """What no step does; NaN where the steps are not whole."""
    return chosen_tree(whole, still, jnp.full_like(still, jnp.nan))


def _first_step(
    argument: str, value: Numbers, params: Params, expected: tuple[int | str, ...]
) -> Array:
    """What a discrete F, Q or b is for one step."""
    made = array(value(params) if callable(value) else value)
    checks.shape(argument, made, expected)
    return made if jnp.issubdtype(made.dtype, jnp.floating) else made.astype(float)


def _first_case(
    cases: list[tuple[Array, Callable[[], Array]]], otherwise: Callable[[], Array]
) -> Array:
    """The value of the first case whose condition holds, else `otherwise`; only that is computed,
    unless the conditions differ in a batch."""
    if all(checks.concrete_value(condition) is not None for condition, _ in cases):
        return next((make for condition, make in cases if condition), otherwise)()
    # One `switch` and not nested `where`s: with times that a batch shares only the branch that is
    # asked for runs; equal steps (k = 1) then cost what a constant F costs.
    index = jnp.zeros((), jnp.int32)
    for number, (condition, _) in enumerate(cases, 1):
        index = jnp.where(condition, jnp.int32(number), index)
    return lax.switch(index, [otherwise, *(make for _, make in cases)])
