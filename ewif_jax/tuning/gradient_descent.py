"""Tuning by gradient: an optax loop over the free numbers of the parameters."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.transforms import Transform, positive, psd, unconstrained
from ewif_jax.tuning.value_gradient import Loss, value_and_gradient
from ewif_jax.types import Numbers, Params, RandomKey, State

if TYPE_CHECKING:
    import optax


class Tuned(NamedTuple):
    """The best parameters seen and their loss, the whole history: loss (steps,) and params
    (steps, ...) as they were when that loss was computed, and why the descent ended."""

    params: Any
    loss: float
    history: dict[str, Any]
    reason: str = ""


def tune(
    loss: Loss,
    params: Params,
    *,
    steps: int = 200,
    optimizer: "optax.GradientTransformation | None" = None,
    transforms: Any = None,
    key: RandomKey = None,
    progress: Callable[[int, int, float], None] | None = None,
) -> Tuned:
    """The best parameters of a gradient descent on `loss`, with the history.

    Args:
        loss: function params -> (), or (params, key) -> () if `key` is given (a fresh key each
            step).
        params: starting values, any pytree of floats.
        steps: number of gradient steps.
        optimizer: any optax optimizer, of the free numbers; default Adam whose rate falls from
            0.1 to 0 along a cosine.
        transforms: a `Transform` for each leaf (a pytree prefix of `params`); default: numbers
            that start positive stay positive, symmetric positive definite matrices stay so,
            everything else is free.
        key: PRNG key for a sampled loss.
        progress: called with (step, steps, loss) after each step.

    A step to where the loss or its gradient is not finite is not kept: the descent goes on from the
    best parameters seen, with steps half as large. `Tuned.reason` says so. With a `key`, losses of
    different steps are not compared, and the last parameters with a finite loss are returned.

    Raises:
        ValueError: steps < 1, a parameter that its transform cannot hold, a loss that is not a
            finite number at the start, starting values that the loss refuses (a negative tau).
    """
    import optax  # here, because it takes longer to import than the rest of the package

    steps = checks.whole("steps", steps, 1)
    params = jax.tree.map(_as_float, params)
    if transforms is None:
        transforms = jax.tree.map(_default_transform, params)
    else:
        transforms = jax.tree.map(
            lambda t, sub: jax.tree.map(lambda _: t, sub),
            transforms,
            params,
            is_leaf=lambda t: isinstance(t, Transform),
        )
    # Known numbers are looked at once, before they are traced: a negative tau is refused here.
    shape = jax.eval_shape(lambda: loss(params) if key is None else loss(params, key)).shape
    checks.require(shape == (), "loss", "a function that returns one number ()", f"shape {shape}")
    is_transform: Callable[[Any], bool] = lambda t: isinstance(t, Transform)  # noqa: E731

    def constrain(free: Params) -> Any:
        return jax.tree.map(lambda t, x: t.constrain(x), transforms, free, is_leaf=is_transform)

    free = jax.tree.map(lambda t, x: t.free(x), transforms, params, is_leaf=is_transform)
    for path, leaf in jax.tree_util.tree_leaves_with_path(free):
        good = np.all(np.isfinite(leaf))
        where = f"params{jax.tree_util.keystr(path)}"
        checks.require(good, where, "a value that its transform can hold", "one it cannot")
    if optimizer is None:
        optimizer = optax.adam(optax.cosine_decay_schedule(0.1, steps))
    state = optimizer.init(free)

    def objective(free: Params, key: RandomKey) -> Array:
        return loss(constrain(free)) if key is None else loss(constrain(free), key)

    def evaluate(free: Params, key: RandomKey) -> tuple[Array, Any, Array, Any]:
        value, gradient = value_and_gradient(objective, free, key)
        finite = [jnp.all(jnp.isfinite(x)) for x in (value, *jax.tree.leaves(gradient))]
        return value, gradient, jnp.all(jnp.stack(finite)), constrain(free)

    @jax.jit
    def advance(free: Params, state: State, scale: Array, key: RandomKey) -> tuple[Any, ...]:
        """A step from `free`, whose loss and gradient are known to be used only if finite."""
        value, gradient, is_finite, params = evaluate(free, key)
        updates, moved = optimizer.update(gradient, state, free)
        updates = jax.tree.map(lambda u: scale.astype(u.dtype) * u, updates)
        return optax.apply_updates(free, updates), moved, value, is_finite, params

    losses, trail = [], []
    best, kept = None, (free, state)
    scale, refused = 1.0, 0
    for k in range(steps + 1):
        draw = None if key is None else jax.random.fold_in(key, min(k, steps - 1))
        start = free, state
        free, state, value, is_finite, shown = advance(free, state, jnp.asarray(scale), draw)
        if k == 0:
            got = f"{float(value)} at the starting values"
            checks.require(np.isfinite(value), "loss", "a finite number", got)
        if bool(is_finite):
            kept = start
            if best is None or key is not None or float(value) <= best[1]:
                best = shown, float(value), start
        else:
            refused += 1
            scale /= 2
            free, state = kept if best is None or key is not None else best[2]
        if k == steps:
            break
        losses.append(value)
        trail.append(shown)
        if progress is not None:
            progress(k + 1, steps, float(value))
    history = {
        "loss": np.asarray(jnp.stack(losses)),
        "params": jax.tree.map(lambda *leaves: np.stack(leaves), *trail),
    }
    if best is None:
        start = jax.tree.map(lambda x: jnp.asarray(x[0]), history["params"])
        return Tuned(start, float(losses[0]), history, "no gradient was finite: nothing was tuned")
    told = f"; {refused} of them led to where the loss or its gradient is not finite"
    reason = f"all {steps} steps were taken{told if refused else ''}"
    return Tuned(*best[:2], history, reason)


def _as_float(x: Numbers) -> Array:
    dtype = jnp.asarray(x).dtype
    floating = jnp.issubdtype(dtype, jnp.floating)
    # Named, so that no type is weak: it would turn strong in the first step, and compile again.
    return jnp.asarray(x, dtype if floating else jnp.asarray(0.0).dtype)


def _default_transform(x: Array) -> Transform:
    value = np.asarray(x)
    if value.ndim == 2 and value.shape[0] == value.shape[1] and np.allclose(value, value.T):
        return psd() if np.linalg.eigvalsh(value).min() > 0 else unconstrained()
    return positive() if np.all(value > 0) else unconstrained()
