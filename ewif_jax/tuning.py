"""Tuning by gradient: losses of an estimator's parameters, and an optax loop over them."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from ewif_jax import checks, scores
from ewif_jax.recipe import FromRecipe, from_recipe
from ewif_jax.scores import Score, average, scored
from ewif_jax.types import Estimator, Measurement

if TYPE_CHECKING:
    import optax

Loss = Callable[..., Array]
FORWARD_UP_TO = 4


class _Transform(NamedTuple):
    constrain: Callable[[Array], Array]
    free: Callable[[Array], Array]


class Transform(FromRecipe, _Transform):
    """A smooth map from free numbers to a constrained parameter, and its inverse."""


class Tuned(NamedTuple):
    """The last parameters and loss, and the whole history: loss (steps,) and params (steps, ...)
    as they were when that loss was computed."""

    params: Any
    loss: float
    history: dict[str, Any]


@from_recipe
def positive() -> Transform:
    """Positive numbers through their logarithm: steps are relative, as suits tau, q and r."""
    return Transform(jnp.exp, jnp.log)


@from_recipe
def psd() -> Transform:
    """Positive definite matrices through their Cholesky factor with a log diagonal."""

    def constrain(raw: Array) -> Array:
        root = jnp.tril(raw, -1) + jnp.diag(jnp.exp(jnp.diag(raw)))
        return root @ root.T

    def free(matrix: Array) -> Array:
        root = jnp.linalg.cholesky(matrix)
        return jnp.tril(root, -1) + jnp.diag(jnp.log(jnp.diag(root)))

    return Transform(constrain, free)


@from_recipe
def unconstrained() -> Transform:
    """Any real numbers."""
    return Transform(lambda x: x, lambda x: x)


def tune(
    loss: Loss,
    params: Any,
    *,
    steps: int = 200,
    optimizer: "optax.GradientTransformation | None" = None,
    transforms: Any = None,
    key: Any = None,
    progress: Callable[[int, int, float], None] | None = None,
) -> Tuned:
    """The parameters after gradient descent on `loss`, with the history.

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

    A step whose gradient is not finite leaves the parameters as they are; the history shows it.

    Raises:
        ValueError: steps < 1, a parameter that its transform cannot hold, a loss that is not a
            finite number at the start.
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
    is_transform: Callable[[Any], bool] = lambda t: isinstance(t, Transform)  # noqa: E731

    def constrain(free: Any) -> Any:
        return jax.tree.map(lambda t, x: t.constrain(x), transforms, free, is_leaf=is_transform)

    free = jax.tree.map(lambda t, x: t.free(x), transforms, params, is_leaf=is_transform)
    for path, leaf in jax.tree_util.tree_leaves_with_path(free):
        good = np.all(np.isfinite(leaf))
        where = f"params{jax.tree_util.keystr(path)}"
        checks.require(good, where, "a value that its transform can hold", "one it cannot")
    if optimizer is None:
        optimizer = optax.adam(optax.cosine_decay_schedule(0.1, steps))
    optimizer = optax.apply_if_finite(optimizer, max_consecutive_errors=steps)
    state = optimizer.init(free)

    def objective(free: Any, key: Any) -> Array:
        return loss(constrain(free)) if key is None else loss(constrain(free), key)

    @jax.jit
    def advance(free: Any, state: Any, key: Any) -> tuple[Any, Any, Array, Any]:
        value, gradient = value_and_gradient(objective, free, key)
        updates, state = optimizer.update(gradient, state, free)
        return optax.apply_updates(free, updates), state, value, constrain(free)

    losses, trail = [], []
    for k in range(steps):
        draw = None if key is None else jax.random.fold_in(key, k)
        free, state, value, before = advance(free, state, draw)
        if k == 0:
            got = f"{float(value)} at the starting values"
            checks.require(np.isfinite(value), "loss", "a finite number", got)
        losses.append(value)
        trail.append(before)
        if progress is not None:
            progress(k + 1, steps, float(value))
    history = {
        "loss": np.asarray(jnp.stack(losses)),
        "params": jax.tree.map(lambda *leaves: np.stack(leaves), *trail),
    }
    *_, final, params = advance(free, state, draw)
    return Tuned(params, float(final), history)


def value_and_gradient(loss: Loss, params: Any, *rest: Any) -> tuple[Array, Any]:
    """`loss(params, *rest)` and its gradient in `params`, a pytree of floats.

    Up to four numbers go through forward mode, which keeps no history, two of them in one pass;
    more through reverse mode.
    """
    flat, unflatten = ravel_pytree(params)
    if flat.size > FORWARD_UP_TO:
        return jax.value_and_grad(loss)(params, *rest)

    def of(x: Array) -> Array:
        return loss(unflatten(x), *rest)

    def along(pair: Array) -> tuple[Array, Array]:
        """The loss and its slopes in two directions, which share the pass of the loss itself.

        The second derivative is not used, so the compiler leaves it out.
        """
        first, second = pair
        (value, one), (other, _) = jax.jvp(
            lambda x: jax.jvp(of, (x,), (first,)), (flat,), (second,)
        )
        return value, jnp.stack([one, other])

    if flat.size == 1:
        value, slope = jax.jvp(of, (flat,), (jnp.ones_like(flat),))
        return value, unflatten(slope[None])
    directions = jnp.eye(flat.size + flat.size % 2, flat.size, dtype=flat.dtype)
    values, slopes = lax.map(along, directions.reshape(-1, 2, flat.size))
    return values[0], unflatten(slopes.reshape(-1)[: flat.size])


def rmse_loss(estimator: Estimator, measurements: Measurement, truth: Any, **setting: Any) -> Loss:
    """params -> RMSE of the first k state components over all runs and arrivals.

    `measurements` is a stream (T, ...) or a batch (R, T, ...), `truth` (T, k) or (R, T, k);
    `setting` (prior, t0, times, clock, key, devices) as in `run_batch`.
    """
    return _loss(estimator, measurements, truth, scores.squared_error, jnp.sqrt, setting)


def likelihood_loss(estimator: Estimator, measurements: Measurement, **setting: Any) -> Loss:
    """params -> mean negative log likelihood of a measurement given the earlier ones."""
    score = scores.negative_log_likelihood
    return _loss(estimator, measurements, None, score, lambda x: x, setting)


def prediction_loss(
    estimator: Estimator, measurements: Measurement, *, robust: bool = False, **setting: Any
) -> Loss:
    """params -> root mean square of the one-step prediction errors, or their mean length
    (`robust`, which outliers pull less). Needs no truth."""
    if robust:
        score = scores.robust_innovation
        return _loss(estimator, measurements, None, score, lambda x: x, setting)
    return _loss(estimator, measurements, None, scores.squared_innovation, jnp.sqrt, setting)


def nees_loss(estimator: Estimator, measurements: Measurement, truth: Any, **setting: Any) -> Loss:
    """params -> squared log of the average NEES over its expectation: 0 if consistent."""
    score = scores.normalised_error
    return _loss(estimator, measurements, truth, score, _squared_log, setting)


def nis_loss(estimator: Estimator, measurements: Measurement, **setting: Any) -> Loss:
    """params -> squared log of the average NIS over its expectation: 0 if consistent."""
    score = scores.normalised_innovation
    return _loss(estimator, measurements, None, score, _squared_log, setting)


def _loss(
    estimator: Estimator,
    measurements: Measurement,
    truth: Any,
    score: Score,
    finish: Callable[[Array], Array],
    setting: Mapping[str, Any],
) -> Loss:
    def loss(params: Any) -> Array:
        values = scored(estimator, params, measurements, truth, scores={"score": score}, **setting)
        return finish(average(values["score"]))

    return loss


def _squared_log(ratio: Array) -> Array:
    return jnp.square(jnp.log(ratio))


def _as_float(x: Any) -> Array:
    dtype = jnp.asarray(x).dtype
    floating = jnp.issubdtype(dtype, jnp.floating)
    # Named, so that no type is weak: it would turn strong in the first step, and compile again.
    return jnp.asarray(x, dtype if floating else jnp.asarray(0.0).dtype)


def _default_transform(x: Array) -> Transform:
    value = np.asarray(x)
    if value.ndim == 2 and value.shape[0] == value.shape[1] and np.allclose(value, value.T):
        return psd() if np.linalg.eigvalsh(value).min() > 0 else unconstrained()
    return positive() if np.all(value > 0) else unconstrained()
