"""Parameters of methods that are tuned, at every point of the grid, on runs of their own."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from ewif_jax import checks
from ewif_jax.lab import methods as lines
from ewif_jax.lab.design import Design
from ewif_jax.lab.methods import Method, Tuning
from ewif_jax.lab.progress import Progress
from ewif_jax.lab.store import Store
from ewif_jax.losses import rmse_loss
from ewif_jax.monte_carlo import simulate_batch
from ewif_jax.tuning import tune
from ewif_jax.types import Params

APART = 2**32 - 1
"""what is folded into the key for runs to tune on: no compared run has that number"""


def tuned_params(design: Design, store: Store, report: Progress) -> dict[int, dict[str, Params]]:
    """The parameters of every method with a `Tuning`, by number of the point."""
    found: dict[int, dict[str, Params]] = {}
    for name, method in design.methods.items():
        if method.tune is None:
            continue
        for number, point in enumerate(design.points):
            place = f"tuned-p{number:05d}-m{list(design.methods).index(name)}"
            if not store.has(place):
                report.say(f"tuning {name!r}, point {number + 1} of {len(design.points)}")
                store.write(place, _tuned_leaves(design, name, method, method.tune, point))
            kept = store.read(place)
            own = lines.at_point(method.params, point)
            structure = jax.tree.structure(own)
            leaves = [kept[f"{i}"] for i in range(structure.num_leaves)]
            found.setdefault(number, {})[name] = jax.tree.unflatten(structure, leaves)
    return found


def _tuned_leaves(
    design: Design, name: str, method: Method, tuning: Tuning, point: Mapping[str, float]
) -> dict[str, np.ndarray]:
    runs = checks.whole(f"methods[{name!r}].tune.runs", tuning.runs, 1)
    leaves, structure = jax.tree.flatten(method.params, is_leaf=lines.is_axis)
    free = [x for x in leaves if not lines.is_axis(x)]
    expected = "parameters to tune (numbers that are no axis)"
    checks.require(free, f"methods[{name!r}].params", expected, repr(method.params))
    key = jax.random.fold_in(design.key, APART) if tuning.key is None else tuning.key
    batch = simulate_batch(design.scenario, jax.random.split(key, runs), design.world_at(point))
    told = method.told_by(design.scenario)

    def whole(free: list[Any]) -> Any:
        left = iter(free)
        filled = [x.at_point(point) if lines.is_axis(x) else next(left) for x in leaves]
        return jax.tree.unflatten(structure, filled)

    loss = (tuning.loss or rmse_loss)(
        method.estimator,
        batch.measurements,
        batch.truth,
        prior=told.prior,
        t0=told.t0,
        times=batch.times,
        clock=told.clock,
        key=jax.random.fold_in(key, 1),
    )
    found = tune(lambda free: loss(whole(free)), free, steps=tuning.steps)
    best = jax.tree.leaves(whole(found.params))
    return {**{f"{i}": np.asarray(x) for i, x in enumerate(best)}, "loss": np.asarray(found.loss)}
