"""What a search found and why it ended, in words."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from ewif_jax.tuning.descents import Descent
from ewif_jax.tuning.domain import Domain
from ewif_jax.tuning.pricing import transform_name
from ewif_jax.tuning.programs import Leaves, Objective
from ewif_jax.tuning.tuned import Tuned


def tuned_from(
    descent: Descent,
    objective: Objective,
    held: Leaves,
    domain: Domain,
    names: Sequence[str],
    method: str,
    steps: int,
) -> Tuned:
    """What one descent found."""
    place = descent.chosen if descent.chosen is not None else 0
    # Histories of one length can be compared and stacked: after the end the best is repeated.
    order = [*range(len(descent.losses)), *[place] * (steps - len(descent.losses))]
    loss = np.asarray(descent.losses)[order]
    trails = [
        np.stack([np.asarray(x) for x in leaf])[order] for leaf in zip(*descent.trail, strict=True)
    ]
    held_trails = tuple(np.broadcast_to(x, (steps, *np.shape(x))) for x in held)
    history = {"loss": loss, "params": objective.params(tuple(trails), held_trails)}
    if descent.validation is not None:
        history["validation"] = np.asarray(descent.held_out)[order]
    params = objective.params(tuple(jnp.asarray(x[place]) for x in trails), held)
    said = ["fixed" if t is None else transform_name(t) for t in domain.transforms]
    transforms = objective.params(tuple(said), ("fixed",) * len(held))
    reason = _reason_ended(descent, domain.notes, names, steps)
    lowest, length, evaluations = float(loss[place]), descent.lengths[place], len(descent.losses)
    return Tuned(params, lowest, history, reason, length, transforms, method, evaluations)


def _reason_ended(descent: Descent, notes: list[str], names: Sequence[str], steps: int) -> str:
    """Why it ended."""
    ended, coordinates = descent.ended, descent.coordinates
    count = len(descent.losses)
    if descent.best is None:
        said = "not finite: no loss with a finite gradient was met, and nothing was tuned"
    elif ended is None:
        said = f"out of steps: all {steps} were taken"
    elif ended.reason == "validation":
        said = f"validation: the held-out loss falls no more, after {count} evaluations"
    elif ended.ends.any():
        parts = np.split(ended.ends, np.cumsum(coordinates.sizes)[:-1])
        ways = {-1: "down", 1: "up"}
        runs = [
            f"{name} can go on {ways[int(x[x != 0][0])]} for nothing"
            for name, x in zip(names, parts, strict=True)
            if x.any()
        ]
        said = f"at a bound: {', '.join(runs)}"
    elif ended.reason == "flat":
        said = "converged: the loss is flat here"
    else:
        said = f"converged: after {count} evaluations no step lowers the loss"
    if descent.refused and descent.best is not None:
        said += f"; {descent.refused} steps led to where the loss or its gradient is not finite"
    return "; ".join([said, *notes])
