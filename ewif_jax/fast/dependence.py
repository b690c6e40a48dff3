"""What of a function depends on which of its inputs, and the function cut in two along that."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
from jax import Array
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, jaxpr_as_fun

from ewif_jax.types import PyTree


class Traced(NamedTuple):
    """A function as its equations."""

    closed: ClosedJaxpr
    outputs: Any
    """Pytree of shapes."""


def traced(fn: Callable[..., Any], *args: Any) -> Traced:
    """`fn` of arguments of these shapes."""
    return Traced(*jax.make_jaxpr(fn, return_shape=True)(*args))


def dependence(fn: Traced, flags: PyTree) -> Any:
    """Which outputs can depend on the flagged inputs (a pytree of bools; never too few)."""
    level = _levels_of(fn, [int(f) for f in jax.tree.leaves(flags)])
    found = [level(v) > 0 for v in fn.closed.jaxpr.outvars]
    return jax.tree.unflatten(jax.tree.structure(fn.outputs), found)


class Divided(NamedTuple):
    """A function in two parts, of lists of arrays."""

    ahead: Callable[[Sequence[Array]], tuple[list[Array], list[Array]]]
    """Inputs of levels 0 and 1 -> outputs not flagged, what the rest needs."""
    rest: Callable[[Sequence[Array], Sequence[Array]], list[Array]]
    """Inputs of levels 0 and 2, what it needs -> outputs flagged."""
    needed: int
    """Bytes of what the rest needs."""


def divided(fn: Traced, levels: Any, flags: PyTree) -> Divided:
    """`fn` in two: what can be computed without the inputs of level 2, and the rest.

    Args:
        fn: the function.
        levels: for every input 0, 1 or 2. What depends on level 0 only is computed in both parts.
        flags: which outputs are left to the rest: all that depend on level 2.
    """
    closed, _ = fn
    jaxpr, numbers = closed.jaxpr, jax.tree.leaves(levels)
    level = _levels_of(fn, numbers)
    flagged = jax.tree.leaves(flags)
    late = [v for v, f in zip(jaxpr.outvars, flagged, strict=True) if f]
    early = [v for v, f in zip(jaxpr.outvars, flagged, strict=True) if not f]

    def computing(outputs: list[Any], at: tuple[int, int]) -> tuple[list[Any], set[Any]]:
        """The equations of these levels behind `outputs`, and all that they read."""
        read, kept = {v for v in outputs if not isinstance(v, Literal)}, []
        # Backwards, so that an equation is kept only if something kept after it reads it: dead code
        # goes.
        for eqn in reversed(jaxpr.eqns):
            if (eqn.effects or read.intersection(eqn.outvars)) and _level_of(eqn, level) in at:
                kept.append(eqn)
                read.update(v for v in eqn.invars if not isinstance(v, Literal))
        return kept[::-1], read

    def part(inputs: list[Any], outputs: list[Any], equations: list[Any]) -> Callable[..., Any]:
        some = jaxpr.replace(invars=inputs, outvars=outputs, eqns=equations)
        return jaxpr_as_fun(ClosedJaxpr(some, closed.consts))

    def inputs_but(number: int) -> list[Any]:
        return [v for v, n in zip(jaxpr.invars, numbers, strict=True) if n != number]

    # Level 0 (parameters that all share) is in both parts: to compute it again costs less than to
    # store it for every arrival. Level 1 is stored where the rest reads it; level 2 is of each run.
    equations, read = computing(late, (0, 2))
    made = [v for eqn in jaxpr.eqns for v in eqn.outvars]
    needed = [v for v in (*jaxpr.invars, *made) if v in read and level(v) == 1]
    rest = part([*inputs_but(1), *needed], late, equations)
    ahead = part(inputs_but(2), [*early, *needed], computing([*early, *needed], (0, 1))[0])

    def first(inputs: Sequence[Array]) -> tuple[list[Array], list[Array]]:
        outputs = ahead(*inputs)
        return outputs[: len(early)], outputs[len(early) :]

    return Divided(
        first,
        lambda inputs, needed: rest(*inputs, *needed),
        sum(v.aval.size * v.aval.dtype.itemsize for v in needed),
    )


def _levels_of(fn: Traced, inputs: list[int]) -> Callable[[Any], int]:
    """Of every variable the highest level of the inputs on which it can depend."""
    jaxpr = fn.closed.jaxpr
    levels = dict(zip(jaxpr.invars, inputs, strict=True))

    def level(v: Any) -> int:
        return 0 if isinstance(v, Literal) else levels.get(v, 0)

    for eqn in jaxpr.eqns:
        levels.update(dict.fromkeys(eqn.outvars, _level_of(eqn, level)))
    return level


def _level_of(eqn: JaxprEqn, level: Callable[[Any], int]) -> int:
    """Of an equation; what is seen from outside (printing) is left where every run goes."""
    return 2 if eqn.effects else max(map(level, eqn.invars), default=0)
