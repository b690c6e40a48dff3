"""Programs of a loss, compiled once for the loss and the shapes of its parameters."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary, ref

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.fast.memo import Memo
from ewif_jax.tuning.value_gradient import Loss, value_and_gradient
from ewif_jax.types import Numbers, Params, RandomKey

MOST_PROGRAMS = 8
"""For one loss: of other fixed leaves, penalties or optimizers."""
_PROGRAMS: WeakKeyDictionary[Loss, Memo] = WeakKeyDictionary()

Leaves = tuple[Numbers, ...]
Priced = tuple[float, list[np.ndarray]]
"""A value, and the slopes along each moving leaf."""


class Objective(NamedTuple):
    """A loss and what is added to it, of leaves of which some move.

    structure: of the parameters; moving: which of its leaves move.
    """

    loss: Loss
    penalty: Loss | None
    structure: Any
    moving: tuple[bool, ...]

    def params(self, moving: Leaves, held: Leaves) -> Params:
        """The parameters of leaves that move and leaves that do not."""
        moves, holds = iter(moving), iter(held)
        leaves = [next(moves) if free else next(holds) for free in self.moving]
        return jax.tree.unflatten(self.structure, leaves)

    def apart(self, leaves: Sequence[Any]) -> tuple[Leaves, Leaves]:
        """The leaves (or what is said of them) that move, and those that do not."""
        pairs = list(zip(leaves, self.moving, strict=True))
        return tuple(x for x, m in pairs if m), tuple(x for x, m in pairs if not m)

    def value(self, moving: Leaves, held: Leaves, key: RandomKey) -> Array:
        """The loss and the penalty."""
        params = self.params(moving, held)
        loss = self.loss(params) if key is None else self.loss(params, key)
        return loss if self.penalty is None else loss + self.penalty(params)

    def program(self, name: Hashable, build: Callable[["Objective"], Callable[..., Any]]) -> Any:
        """What `build` makes of this objective, kept while the loss lives.

        What is kept refers to the loss weakly: it would keep it, and its data, alive.
        """
        try:
            kept = _PROGRAMS.setdefault(self.loss, Memo(MOST_PROGRAMS))
            loss = ref(self.loss)
        except TypeError:  # it cannot be looked up again
            return build(self)

        def same_loss(*args: Any) -> Array:
            found = loss()
            assert found is not None
            return found(*args)

        question = (name, self.penalty, self.structure, self.moving)
        program = kept.get(question)
        if program is None:
            program = build(self._replace(loss=same_loss))
            kept.keep(question, program)
        return program

    def evaluate(self, points: list[Leaves], held: Leaves, key: RandomKey) -> list[Priced]:
        """Value and slopes at each of the points, in one call if there are several."""
        if len(points) == 1:
            values, slopes = self.program("single", _single_program)(points[0], held, key)
            return [(float(values), [np.asarray(x) for x in slopes])]
        stacked = tuple(jnp.stack(leaves) for leaves in zip(*points, strict=True))
        values, slopes = self.program("many", _many_program)(stacked, held, key)
        values, slopes = np.asarray(values), [np.asarray(x) for x in slopes]
        return [(float(values[k]), [x[k] for x in slopes]) for k in range(len(points))]


def _single_program(objective: Objective) -> Callable[..., Any]:
    def evaluated(moving: Leaves, held: Leaves, key: RandomKey) -> tuple[Array, Any]:
        return value_and_gradient(objective.value, moving, held, key)

    return jax.jit(evaluated)


def _many_program(objective: Objective) -> Callable[..., Any]:
    def evaluated(moving: Leaves, held: Leaves, key: RandomKey) -> tuple[Array, Any]:
        return value_and_gradient(objective.value, moving, held, key)

    return jax.jit(jax.vmap(evaluated, (0, None, None)))
