"""`tune`: the parameters at which a loss is least."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from ewif_jax import checks
from ewif_jax.tuning.descents import Descent, by_optimizer, descend
from ewif_jax.tuning.domain import (
    found_domain,
    given_transforms,
    held_leaves,
    leaf_names,
)
from ewif_jax.tuning.pricing import Coordinates, Pricer, as_float
from ewif_jax.tuning.programs import Leaves, Objective
from ewif_jax.tuning.quasi_newton import quasi_newton
from ewif_jax.tuning.starting import start_count, start_leaves, start_points, step_widths
from ewif_jax.tuning.telling import tuned_from
from ewif_jax.tuning.tuned import Tuned
from ewif_jax.tuning.value_gradient import Loss
from ewif_jax.types import Params, PyTree, RandomKey

if TYPE_CHECKING:
    import optax

FEW = 50
"""Free numbers up to which the quasi-Newton method is the default: it keeps a matrix of them."""
METHODS = ("quasi-newton", "lbfgs", "adam")


def tune(
    loss: Loss,
    params: Params,
    *,
    method: Literal["quasi-newton", "lbfgs", "adam"] | None = None,
    optimizer: "optax.GradientTransformation | None" = None,
    steps: int = 200,
    starts: PyTree = None,
    transforms: PyTree = None,
    fixed: PyTree = None,
    penalty: Loss | None = None,
    validation: Loss | None = None,
    patience: int = 10,
    key: RandomKey = None,
    progress: Callable[[int, int, float], None] | None = None,
) -> Tuned:
    r"""The parameters at which a loss is least, and why the search for them ended.

    .. math::
        \min_p \; \text{loss}(p) + \text{penalty}(p)

    Of what has been evaluated the best is returned. A step to where the loss or its gradient is not
    finite is refused and shortened.

    **The method**, unless `method` or `optimizer` says it: Adam for a sampled loss (with `key`);
    else a quasi-Newton method in a trust region for up to 50 free numbers, and L-BFGS for more. The
    quasi-Newton method ends when it has converged, and then looks around: a factor 10 and 100 up
    and down in each parameter that has a bound (if there are at most 6). From what is lower there
    it descends again.

    **The domain**, unless `transforms` says it, is found: at the start, the sign of each leaf is
    flipped (one of 0 becomes a small negative number). Where the loss refuses that, or is not
    finite, the leaf keeps its sign and moves in logarithms (a symmetric positive definite matrix:
    by its Cholesky factor); any other is free. A leaf that starts at 0 and cannot be negative is
    moved to the smallest value (of powers of ten) that lowers the loss; if none does, it stays 0.

    Args:
        loss: function params -> (), or (params, key) -> () if `key` is given (a fresh key each
            step).
        params: starting values, any pytree of floats.
        method: "quasi-newton", "lbfgs", or "adam" (whose rate falls from 0.1 to 0 along a cosine).
        optimizer: any optax optimizer, of the free numbers, instead; those that look at the loss
            (L-BFGS, Polyak steps, `reduce_on_plateau`) are given what they ask for.
        steps: at most so many evaluations of the loss and its gradient, from each start.
        starts: many starting points, which go on side by side in one batched call: a pytree like
            `params` whose leaves have a leading axis S, a list of such pytrees, or a number S
            (`params` and S - 1 points spread evenly up to a factor 100 about them). The best end is
            returned; `Tuned.starts` has all.
        transforms: a `Transform` for each leaf (a pytree prefix of `params`, or a mapping of some
            of its names); `transforms.bounded(low, high)` sets bounds.
        fixed: what does not move: names, a pytree prefix of bools, or a mapping of names to values
            at which they are held.
        penalty: function params -> (), added to the loss: minus the logarithm of a prior density
            makes the maximum of the posterior of minus `log_likelihood`. (`likelihood_loss` is an
            average over rows: the penalty of one is to be divided by their number.)
        validation: another loss, params -> (), of data that were held out. It is asked where the
            loss is the least so far; after `patience` times without a new least of it the search
            ends. The parameters with the least held-out loss are returned.
        patience: see there.
        key: PRNG key for a sampled loss. Losses of different steps are then not compared, and the
            last parameters with a finite loss are returned.
        progress: called with (evaluation, steps, loss) after each evaluation.

    Returns:
        `Tuned`.

    Programs are compiled once for a loss (the same object) and shapes of parameters: a second call
    compiles nothing.

    Raises:
        ValueError: steps < 1, a parameter that its transform cannot hold, a loss that is not a
            finite number at the start, starting values that the loss refuses (a negative tau);
            names that are none; both a method and an optimizer.
    """
    steps = checks.whole("steps", steps, 1)
    checks.whole("patience", patience, 1)
    ok = method is None or method in METHODS
    checks.require(ok, "method", f"one of {', '.join(METHODS)}", repr(method))
    both = method is not None and optimizer is not None
    checks.require(not both, "optimizer", "either a method or an optimizer", "both")
    whole, moves = held_leaves(fixed, params)
    whole = jax.tree.map(as_float, whole)
    objective = Objective(loss, penalty, jax.tree.structure(whole), tuple(moves))
    checks.require(any(moves), "fixed", "at least one parameter that moves", "all fixed")
    begins = start_leaves(starts, whole)
    moving, held = objective.apart(begins[0] if begins else jax.tree.leaves(whole))
    # Known numbers are looked at once, before they are traced: a negative tau is refused here.
    for leaves in begins or [jax.tree.leaves(whole)]:
        own = objective.apart(leaves)
        shape = jax.eval_shape(lambda own=own: objective.value(own[0], own[1], key)).shape
        checks.require(shape == (), "loss", "one number, shape ()", f"shape {shape}")

    def refuses(moving: Leaves) -> bool:
        try:
            jax.eval_shape(lambda: objective.value(moving, held, key))
        except ValueError:
            return True
        return False

    names = objective.apart(leaf_names(whole))[0]
    given = objective.apart(given_transforms(transforms, whole))[0]
    pricer = Pricer(objective, held, len(begins) or start_count(starts), key)
    domain = found_domain(given, names, moving, pricer, refuses)
    coordinates = Coordinates(domain.transforms, domain.start)
    others = [objective.apart(leaves)[0] for leaves in begins[1:]]
    points = start_points(starts, domain.start, others, coordinates)
    _refuse_what_cannot_be_held(points, coordinates, names)
    rounding = max(10 * max(float(jnp.finfo(x.dtype).eps) for x in moving), 1e-12)
    chosen = method or _default_method(key, points[0].size)
    held_out = _held_out(validation, objective, held)
    descents = []
    for point in points:
        if optimizer is None and chosen == "quasi-newton":
            asking = quasi_newton(
                point, step_widths(point, coordinates), coordinates.each_has_ends, rounding
            )
        else:
            stops_at = rounding**0.5 if optimizer is None and chosen == "lbfgs" else None
            used = optimizer or _kept_optimizer(chosen, steps)
            asking = by_optimizer(used, point, coordinates, objective, pricer, stops_at)
        descents.append(Descent(asking, coordinates, key is None, held_out, patience))
    descend(descents, pricer, steps, progress)
    label = chosen if optimizer is None else "optimizer"
    found = [tuned_from(d, objective, held, domain, names, label, steps) for d in descents]
    first = [t.history["loss"][0] for t in found]
    got = f"{first[0]} at the starting values"
    checks.require(np.isfinite(first).any(), "loss", "a finite number", got)
    best = min(found, key=lambda t: t.loss if np.isfinite(t.loss) else np.inf)
    several = tuple(found) if len(found) > 1 else ()
    return best._replace(evaluations=pricer.evaluations, starts=several)


def _refuse_what_cannot_be_held(
    points: Sequence[np.ndarray], coordinates: Coordinates, names: Sequence[str]
) -> None:
    for point in points:
        for name, x in zip(names, coordinates.split(point), strict=True):
            is_held = np.all(np.isfinite(x))
            expected = "a value that its transform can hold"
            checks.require(is_held, f"params['{name}']", expected, "one it cannot")


def _default_method(key: RandomKey, size: int) -> str:
    if key is not None:
        return "adam"
    return "quasi-newton" if size <= FEW else "lbfgs"


@cache
def _kept_optimizer(method: str, steps: int) -> Any:
    """One object for equal settings, so that nothing is compiled again."""
    import optax  # here, because it takes longer to import than the rest of the package

    if method == "lbfgs":
        return optax.lbfgs()
    return optax.adam(optax.cosine_decay_schedule(0.1, steps))


def _held_out(
    validation: Loss | None, objective: Objective, held: Leaves
) -> Callable[[Leaves], float] | None:
    """The held-out loss of the leaves that move."""
    if validation is None:
        return None
    own = Objective(validation, None, objective.structure, objective.moving)

    def build(objective: Objective) -> Callable[..., Any]:
        return jax.jit(lambda moving, held: objective.value(moving, held, None))

    program = own.program("value", build)
    return lambda moving: float(program(moving, held))
