"""Points of the parameters and what they cost, from the start of a tuning to its end."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.transforms import Transform, unconstrained
from ewif_jax.tuning.programs import Leaves, Objective, Priced
from ewif_jax.types import Numbers, Params, RandomKey


class Pricer:
    """Evaluates an objective at `width` points at a time, and counts how often.

    A call of fewer points is filled up: another shape would be compiled again.
    """

    def __init__(self, objective: Objective, held: Leaves, width: int, key: RandomKey):
        self.objective = objective
        self.held = held
        self.width = width
        self.key = key
        self.evaluations = 0

    def prices(self, points: Sequence[Leaves], turn: int = 0) -> list[Priced]:
        """Value and slopes at each point; `turn` says which random numbers a sampled loss draws."""
        key = None if self.key is None else jax.random.fold_in(self.key, turn)
        found: list[Priced] = []
        for first in range(0, len(points), self.width):
            some = list(points[first : first + self.width])
            self.evaluations += len(some)
            filled = some + [some[-1]] * (self.width - len(some))
            found += self.objective.evaluate(filled, self.held, key)[: len(some)]
        return found

    def value(self, point: Leaves) -> float:
        """The loss of one point; infinite where it is not a number."""
        value = self.prices([point])[0][0]
        return np.inf if np.isnan(value) else value


class Coordinates:
    """The free numbers of leaves: each leaf's through its transform, as one vector (n,).

    A leaf without a transform stays where it is: its slopes are 0.
    """

    def __init__(self, transforms: Sequence[Transform | None], start: Leaves):
        self.stays = [t is None for t in transforms]
        self.transforms = tuple(unconstrained() if t is None else t for t in transforms)
        free = [t.free(jnp.asarray(x)) for t, x in zip(self.transforms, start, strict=True)]
        self.like = tuple(np.asarray(x) for x in free)
        self.sizes = [x.size for x in self.like]

    def leaves(self, point: np.ndarray) -> Leaves:
        """The parameters of a point (n,) of the free numbers."""
        return _constrained(self.transforms, self.split(point))

    def vector(self, leaves: Leaves) -> np.ndarray:
        """The free numbers (n,) of parameters."""
        free = [t.free(jnp.asarray(x)) for t, x in zip(self.transforms, leaves, strict=True)]
        return np.concatenate([np.ravel(np.asarray(x, float)) for x in free])

    def slopes(self, point: np.ndarray, slopes: Sequence[np.ndarray]) -> np.ndarray:
        """The gradient (n,) in the free numbers of one in the parameters."""
        pulled = _pulled(self.transforms, self.split(point), tuple(slopes))
        parts = [
            np.zeros(x.size) if stays else np.ravel(np.asarray(x, float))
            for x, stays in zip(pulled, self.stays, strict=True)
        ]
        return np.concatenate(parts)

    @property
    def each_has_ends(self) -> np.ndarray:
        """(n,) whether a number stands for a parameter with a bound."""
        return self.each([has_ends(t) for t in self.transforms])

    def each(self, of_leaf: Sequence[Any]) -> np.ndarray:
        """What is said of each leaf, for each number (n,)."""
        return np.concatenate([np.full(n, x) for n, x in zip(self.sizes, of_leaf, strict=True)])

    def split(self, point: np.ndarray) -> Leaves:
        """The free numbers of a vector (n,), leaf by leaf."""
        parts = np.split(point, np.cumsum(self.sizes)[:-1])
        return tuple(
            x.reshape(like.shape).astype(like.dtype)
            for x, like in zip(parts, self.like, strict=True)
        )


def _constrained_leaves(transforms: tuple[Transform, ...], free: Leaves) -> tuple[Array, ...]:
    return tuple(t.constrain(x) for t, x in zip(transforms, free, strict=True))


def _pulled_slopes(
    transforms: tuple[Transform, ...], free: Leaves, slopes: Leaves
) -> tuple[Array, ...]:
    def constrained(free: Leaves) -> tuple[Array, ...]:
        return _constrained_leaves(transforms, free)

    return jax.vjp(constrained, free)[1](tuple(slopes))[0]


_constrained: Callable[..., Leaves] = jax.jit(_constrained_leaves, static_argnums=0)
_pulled: Callable[..., Leaves] = jax.jit(_pulled_slopes, static_argnums=0)


def transform_name(transform: Transform) -> str:
    """How it was made."""
    return "custom" if transform.recipe is None else transform.recipe.shown(1)


def has_ends(transform: Transform) -> bool:
    """Whether it stands for a parameter with a bound, number by number."""
    return not transform_name(transform).startswith(("unconstrained", "psd"))


def as_float(x: Numbers) -> Params:
    """A leaf of the parameters as an array of floats."""
    dtype = jnp.asarray(x).dtype
    floating = jnp.issubdtype(dtype, jnp.floating)
    # Named, so that no type is weak: it would turn strong in the first step, and compile again.
    return jnp.asarray(x, dtype if floating else jnp.asarray(0.0).dtype)
