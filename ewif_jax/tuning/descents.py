"""Descents side by side: each asks for points, is told what they cost, and keeps the best seen."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ewif_jax.tuning.pricing import Coordinates, Pricer
from ewif_jax.tuning.programs import Leaves, Objective
from ewif_jax.tuning.quasi_newton import Asked, Ended
from ewif_jax.types import Params, PyTree

Told = Callable[[int, int, float], None]
Validation = Callable[[Params], Any]


@dataclass
class Descent:
    """One descent: what it asks for next, and what it has seen.

    compares: whether losses of different turns can be compared (those of a sampled loss cannot).
    """

    asking: Asked
    coordinates: Coordinates
    compares: bool
    validation: Callable[[Leaves], float] | None = None
    patience: int = 10
    losses: list[float] = field(default_factory=list)
    trail: list[Leaves] = field(default_factory=list)
    held_out: list[float] = field(default_factory=list)
    best: int | None = None
    chosen: int | None = None
    lengths: list[float] = field(default_factory=list)
    refused: int = 0
    ended: Ended | None = None
    point: np.ndarray | None = None

    def begin(self) -> None:
        """Asks for the first point."""
        self.point = next(self.asking)

    def told(self, value: float, slopes: list[np.ndarray]) -> None:
        """Takes what the point costs, and asks for the next, or ends."""
        assert self.point is not None
        gradient = self.coordinates.slopes(self.point, slopes)
        is_finite = np.isfinite(value) and np.isfinite(gradient).all()
        place = len(self.losses)
        self.losses.append(value)
        self.trail.append(self.coordinates.leaves(self.point))
        self.lengths.append(float(np.linalg.norm(gradient)))
        self.held_out.append(np.nan)
        if not is_finite:
            self.refused += 1
        elif self.best is None or not self.compares or value <= self.losses[self.best]:
            self.best = place
            self._validate(place)
        if self.ended is not None:
            self.asking.close()
            return
        try:
            self.point = self.asking.send((value, gradient))
        except StopIteration as end:
            self.ended = end.value

    def _validate(self, place: int) -> None:
        """Asks for the held-out loss where the loss is the least so far."""
        if self.validation is None:
            self.chosen = place
            return
        self.held_out[place] = self.validation(self.trail[place])
        asked = [k for k, x in enumerate(self.held_out) if np.isfinite(x)]
        if asked:
            self.chosen = min(asked, key=lambda k: self.held_out[k])
            if sum(k > self.chosen for k in asked) >= self.patience:
                self.ended = Ended("validation", np.zeros(0, int))


def descend(descents: list[Descent], pricer: Pricer, most: int, progress: Told | None) -> None:
    """Runs all of them to their end, at most `most` evaluations each."""
    for descent in descents:
        descent.begin()
    for turn in range(most):
        running = [d for d in descents if d.ended is None]
        if not running:
            break
        points = [d.coordinates.leaves(d.point) for d in running if d.point is not None]
        for descent, price in zip(running, pricer.prices(points, turn), strict=True):
            descent.told(*price)
        if progress is not None:
            told = turn + 1 if any(d.ended is None for d in descents) else most
            progress(told, most, float(np.min([d.losses[-1] for d in running])))


class Reached(NamedTuple):
    """Where an optimizer can go on from: the free numbers (n,), value, gradient and its state."""

    point: np.ndarray
    value: float
    gradient: np.ndarray
    state: Any


def by_optimizer(
    optimizer: Any,
    start: np.ndarray,
    coordinates: Coordinates,
    objective: Objective,
    pricer: Pricer,
    stops_at: float | None,
) -> Asked:
    """Steps of an optax optimizer of the free numbers, which it sees as a tree like the parameters.

    A step to where the loss or its gradient is not finite is taken back: it goes on from the best
    point seen (of a sampled loss from the last), with steps half as large.

    Args:
        optimizer: of optax; what looks at the loss itself is given value, gradient and loss.
        start: (n,) free numbers.
        coordinates, objective, pricer: what is minimised.
        stops_at: the gradient relative to the loss at which it ends; None: never.
    """
    take = stepping(optimizer, coordinates, objective)
    state = optimizer.init(objective.params(coordinates.split(start), pricer.held))
    nowhere = np.zeros(len(start), int)
    point, scale, best, refused = start, 1.0, None, False
    last: Reached | None = None
    turn = 0
    while True:
        value, gradient = yield point
        if np.isfinite(value) and np.isfinite(gradient).all():
            last = Reached(point, value, gradient, state)
            if best is None or pricer.key is not None or value <= best.value:
                best = last
            if stops_at is not None and np.linalg.norm(gradient) <= stops_at * abs(value):
                return Ended("converged", nowhere, refused)
        elif best is None:
            return Ended("not finite", nowhere, True)
        else:
            # The optimizer's state goes back too, not the point alone: momentum that led out of the
            # domain would lead there again.
            refused, scale, last = True, scale / 2, best
        assert last is not None
        key = None if pricer.key is None else jax.random.fold_in(pricer.key, turn)
        slopes = coordinates.split(last.gradient)
        free = coordinates.split(last.point)
        moved, state = take(free, slopes, pricer.held, last.state, last.value, scale, key)
        point = np.concatenate([np.ravel(np.asarray(x, float)) for x in moved])
        turn += 1


def stepping(optimizer: Any, coordinates: Coordinates, objective: Objective) -> Any:
    """A step of the optimizer, compiled once: (free leaves, slopes, held leaves, state, value,
    scale, key) -> (free leaves, state)."""
    import optax  # here, because it takes longer to import than the rest of the package

    optimizer = optax.with_extra_args_support(optimizer)
    transforms = coordinates.transforms

    def build(objective: Objective) -> Callable[..., Any]:
        def taken(
            free: Leaves,
            slopes: Leaves,
            held: Leaves,
            state: PyTree,
            value: PyTree,
            scale: PyTree,
            key: PyTree,
        ) -> tuple[list[Any], Any]:
            def loss(tree: Params) -> Any:
                own = [t.constrain(x) for t, x in zip(transforms, moving(tree), strict=True)]
                return objective.value(tuple(own), held, key)

            def moving(tree: Params) -> list[Any]:
                leaves = jax.tree.leaves(tree)
                return [x for x, moves in zip(leaves, objective.moving, strict=True) if moves]

            zeros = tuple(jnp.zeros_like(x) for x in held)
            tree = objective.params(free, held)
            gradient = objective.params(slopes, zeros)
            value = jnp.asarray(value, jnp.result_type(*free))
            updates, new = optimizer.update(
                gradient, state, tree, value=value, grad=gradient, value_fn=loss
            )
            updates = jax.tree.map(lambda u: jnp.asarray(scale, u.dtype) * u, updates)
            return moving(optax.apply_updates(tree, updates)), new

        return jax.jit(taken)

    return objective.program(("step", optimizer, transforms), build)
