"""The actual error of a Kalman-Bucy filter while it settles, and its bounds."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.analysis.anderson_continuous import ContinuousSystem, check_continuous
from ewif_jax.continuous.kalman_bucy import (
    check_design,
    check_increasing,
    check_solver,
    matrices,
    need_diffrax,
    solve,
    split,
)
from ewif_jax.kernels import symmetric
from ewif_jax.streams import float_dtype
from ewif_jax.types import Numbers, Parameter, Params


class ErrorCurve(NamedTuple):
    """time (K,), error: E (K, n, n), what happens, and design: Pi (K, n, n), what is believed."""

    time: Array
    error: Array
    design: Array


class ErrorBounds(NamedTuple):
    """time (K,), and best <= error <= design (4-11), each (K, n, n): P, what the filter without
    weighting achieves, E, what the weighted one achieves, and Pi, what the weighted one believes.
    """

    time: Array
    best: Array
    error: Array
    design: Array


def actual_error_continuous(
    system: ContinuousSystem,
    params: Params,
    cov0: Numbers,
    *,
    times: Numbers,
    fading_rate: Parameter = 0.0,
    truth: ContinuousSystem | None = None,
    mean0: Numbers = None,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 65_536,
) -> ErrorCurve:
    r"""The actual mean square error of the weighted filter, in whatever true system.

    .. math::
        \dot{\mathcal E} = (F - K H) \mathcal E + \mathcal E (F - K H)' + G Q G' + K R K'
        \quad (4\text{-}9), \qquad K = \Pi_\alpha H' R^{-1}

    Anderson (1973), section 4. The noises are the true ones, K is of the filter's design. Where the
    true F and H are others than the design's, :math:`F_d` and :math:`H_d`, the error e depends on
    the state x, and the second moments of both are carried:

    .. math::
        d e = ((F_d - K H_d) e + (F - F_d - K (H - H_d)) x) dt + G\, dw - K\, dv

    Args:
        system: what the filter is designed for; `kalman_bucy` describes it and `fading_rate`.
        params: what the functions of both systems are read from.
        cov0: E and Pi (n, n) at times[0].
        times: (K,) increasing seconds.
        fading_rate: alpha >= 0 in 1/s, a constant or a function (params, t).
        truth: the true system, default `system`; each of its matrices a constant or a function
            (params, t), of as many states and measurements.
        mean0: true mean of the initial state (n,), default 0; it matters with a `truth` only, the
            estimate being assumed to start there.
        rtol, atol, max_steps: of the solver, as in `kalman_bucy`.

    Raises:
        ValueError: wrong shapes; a cov0 or Q that is not PSD, an R that is not positive definite
            (functions as they are at times[0]); fading_rate < 0; times that do not increase.
        ImportError: diffrax is not installed.

    Reduces to: E = Pi for alpha = 0 and a true design; P <= E <= Pi (4-11) otherwise; (4-9) where
        the truth differs in its noises only.
    """
    need_diffrax()
    checks.shape("cov0", cov0, ("n", "n"))
    checks.psd("cov0", cov0)
    checks.shape("times", times, ("K",))
    check_increasing("times", times)
    check_solver(rtol, atol, max_steps)
    dtype, n = float_dtype(cov0), np.shape(cov0)[0]
    cov0, times = jnp.asarray(cov0, dtype), jnp.asarray(times, dtype)
    check_design(system, fading_rate, params, times[0], n)
    mean0 = jnp.zeros(n, dtype) if mean0 is None else mean0
    checks.shape("mean0", mean0, (n,))
    checks.finite("mean0", mean0)
    used, real = split((*system, fading_rate), dtype), None
    if truth is not None:
        m = matrices(*used, params)(times[0]).H.shape[0]
        check_continuous("truth", truth, n, m, params=params, start=times[0])
        real = split((*truth, 0.0), dtype)
    functions = used[0], None if real is None else real[0]
    constants = used[1], None if real is None else real[1]
    start = cov0, jnp.asarray(mean0, dtype)
    return _error_curve(functions, constants, params, start, times, (rtol, atol, max_steps))


def error_bounds_continuous(
    system: ContinuousSystem,
    params: Params,
    cov0: Numbers,
    *,
    times: Numbers,
    fading_rate: Parameter = 0.0,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 65_536,
) -> ErrorBounds:
    r"""The bounds :math:`P(t) \le \mathcal E(t) \le \Pi_\alpha(t)` (4-11), all three.

    Anderson (1973), section 4, for a filter that is designed for the true system. Arguments and
    errors as in `actual_error_continuous`.

    Reduces to: three equal covariances for alpha = 0.
    """
    setting: dict[str, Any] = {"times": times, "rtol": rtol, "atol": atol, "max_steps": max_steps}
    curve = actual_error_continuous(system, params, cov0, fading_rate=fading_rate, **setting)
    best = actual_error_continuous(system, params, cov0, fading_rate=0.0, **setting).design
    return ErrorBounds(curve.time, best, curve.error, curve.design)


@partial(jax.jit, static_argnames=("functions", "tolerances"))
def _error_curve(
    functions: tuple,
    constants: tuple,
    params: Params,
    start: tuple[Array, Array],
    times: Array,
    tolerances: tuple,
) -> ErrorCurve:
    used = matrices(functions[0], constants[0], params)
    cov0, mean0 = start
    n = mean0.size

    def own(t: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        error, cov = (symmetric.unpack(x) for x in state)
        now = used(t)
        K = now.gain(cov)
        moved = (now.F - K @ now.H) @ error
        slope = moved + moved.T + now.noise + K @ now.R @ K.T
        return symmetric.pack(slope), symmetric.pack(now.slope(cov))

    def other(t: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        both, cov = (symmetric.unpack(x) for x in state)
        now, world = used(t), real(t)
        K = now.gain(cov)
        leak = world.F - now.F - K @ (world.H - now.H)
        move = jnp.block([[world.F, jnp.zeros_like(leak)], [leak, now.F - K @ now.H]])
        driven = world.noise + K @ world.R @ K.T
        # State and error share the process noise w; the measurement noise enters the error alone.
        noise = jnp.block([[world.noise, world.noise], [world.noise, driven]])
        moved = move @ both
        return symmetric.pack(moved + moved.T + noise), symmetric.pack(now.slope(cov))

    if functions[1] is None:
        first, field = cov0, own
    else:
        real = matrices(functions[1], constants[1], params)
        # E[x x'] = P0 + m m', and the error x - m at the start has covariance P0 with x and with
        # itself: the estimate starts at the mean.
        first = jnp.block([[cov0 + jnp.outer(mean0, mean0), cov0], [cov0, cov0]])
        field = other
    found, design = solve(field, (symmetric.pack(first), symmetric.pack(cov0)), times, *tolerances)
    error = jax.vmap(symmetric.unpack)(found)[:, -n:, -n:]
    return ErrorCurve(times, error, jax.vmap(symmetric.unpack)(design))
