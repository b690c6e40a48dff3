"""Savitzky-Golay coefficients, as the least squares of a polynomial model."""

from functools import cache, partial
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.models.model import Model, linear_model
from ewif_jax.smoothers.batch_wls import batch_wls
from ewif_jax.streams import stream


def savgol(
    window_length: int,
    polyorder: int,
    *,
    deriv: int = 0,
    delta: float = 1.0,
    pos: float | None = None,
) -> Array:
    r"""Coefficients c (window_length,) of the Savitzky-Golay filter, oldest sample first.

    c @ window is the `deriv`-th derivative at sample `pos` of the polynomial fitted to the window:
    `batch_wls` with W = 1 for the model whose state is the value and its derivatives
    (Shulami & Sigalov, section IV-A.2, and the kernel (5)).

    Args:
        window_length: number of equally spaced samples.
        polyorder: order of the polynomial, < window_length.
        deriv: which derivative, >= 0.
        delta: spacing of the samples in seconds; the derivative is per delta^deriv.
        pos: where in the window, 0 (oldest) to window_length - 1 (newest: a causal filter);
            default the middle.

    Reduces to: `scipy.signal.savgol_coeffs(..., use="dot")`.

    Deviations: the normal equations printed in section IV-A.2 give the state at time zero, not at
        t_k; here times count from `pos`.

    Raises:
        ValueError: sizes out of range, delta <= 0, or `pos` outside the window.
    """
    checks.whole("window_length", window_length, 1)
    checks.whole("polyorder", polyorder, 0)
    checks.whole("deriv", deriv, 0)
    short = polyorder < window_length
    checks.require(short, "polyorder", f"less than window_length {window_length}", polyorder)
    checks.positive("delta", delta)
    middle = (window_length - 1) / 2
    pos = middle if pos is None else float(pos)
    inside = 0 <= pos <= window_length - 1
    checks.require(inside, "pos", f"a sample between 0 and {window_length - 1}", pos)
    if deriv > polyorder:
        return jnp.zeros(window_length)
    return (
        _fitted_coefficients(_polynomial_model(polyorder), window_length, pos)[:, deriv]
        / delta**deriv
    )


@partial(jax.jit, static_argnames=("model", "window_length"))
def _fitted_coefficients(model: Model, window_length: int, pos: Array) -> Array:
    """The state at `pos` that is fitted to one at each sample and zero at the others, (W, n)."""
    samples = stream(jnp.arange(window_length) - pos, jnp.zeros(window_length))

    def fitted(value: Array) -> Array:
        window = samples._replace(value=value[:, None])
        return batch_wls(model, None, window, jnp.zeros(1), weight=_check_even).mean[0]

    # The fit is linear in the samples, so its answers to unit samples are the coefficients.
    return jax.vmap(fitted)(jnp.eye(window_length))


@cache
def _polynomial_model(order: int) -> Model:
    """The state [value, first derivative, ...] of a polynomial, and a look at its value."""
    lift = np.arange(order + 1)[None, :] - np.arange(order + 1)[:, None]
    scale = np.where(lift >= 0, [[1 / factorial(max(k, 0)) for k in row] for row in lift], 0)

    def F(params: None, t0: Array, t1: Array) -> Array:
        return jnp.asarray(scale, t0.dtype) * (t1 - t0) ** np.maximum(lift, 0)

    return linear_model(F, np.eye(1, order + 1), np.eye(1))


def _check_even(params: None, measured: Array, at: Array) -> Array:
    return jnp.ones_like(at)
