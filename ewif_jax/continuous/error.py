"""The actual error of a Kalman-Bucy filter while it settles."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.analysis.anderson_continuous import ContinuousSystem
from ewif_jax.continuous.kalman_bucy import matrices, need_diffrax, solve, split
from ewif_jax.kernels import symmetric


class ErrorCurve(NamedTuple):
    """time (K,), error: E (K, n, n), what happens, and design: Pi (K, n, n), what is believed."""

    time: Array
    error: Array
    design: Array


def actual_error_continuous(
    system: ContinuousSystem,
    params: Any,
    cov0: Any,
    *,
    times: Any,
    fading_rate: Any = 0.0,
    truth: ContinuousSystem | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 65_536,
) -> ErrorCurve:
    r"""The actual mean square error of the weighted filter.

    .. math::
        \dot{\mathcal E} = (F - K H) \mathcal E + \mathcal E (F - K H)' + G Q G' + K R K'
        \quad (4\text{-}9), \qquad K = \Pi_\alpha H' R^{-1}

    Anderson (1973), section 4. G Q G' and R are the true ones, K is of the filter's design.

    Args:
        system: what the filter is designed for; `kalman_bucy` describes it and `fading_rate`.
        params: what its functions are read from.
        cov0: E and Pi (n, n) at times[0].
        times: (K,) increasing seconds.
        truth: the system whose noises are real, default `system`. Its F and H must be those of the
            design (then the error does not depend on the state).
        rtol, atol, max_steps: of the solver, as in `kalman_bucy`.

    Raises:
        ValueError: shapes, or a cov0 that is not a covariance.
        ImportError: diffrax is not installed.

    Reduces to: E = Pi for alpha = 0 and a true design; P <= E <= Pi (4-11) otherwise.
    """
    need_diffrax()
    checks.psd("cov0", cov0)
    checks.shape("times", times, ("K",))
    cov0 = jnp.asarray(cov0)
    used = split((*system, fading_rate), cov0.dtype)
    real = split((*(system if truth is None else truth), 0.0), cov0.dtype)
    return _error_curve(
        (used[0], real[0]),
        (used[1], real[1]),
        params,
        cov0,
        jnp.asarray(times, cov0.dtype),
        (rtol, atol, max_steps),
    )


@partial(jax.jit, static_argnames=("functions", "tolerances"))
def _error_curve(
    functions: tuple, constants: tuple, params: Any, cov0: Array, times: Array, tolerances: tuple
) -> ErrorCurve:
    used, real = (matrices(f, c, params) for f, c in zip(functions, constants, strict=True))

    def field(t: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        error, cov = (symmetric.unpack(x) for x in state)
        now, world = used(t), real(t)
        K = now.gain(cov)
        moved = (now.F - K @ now.H) @ error
        slope = moved + moved.T + world.noise + K @ world.R @ K.T
        return symmetric.pack(slope), symmetric.pack(now.slope(cov))

    start = symmetric.pack(cov0), symmetric.pack(cov0)
    error, design = solve(field, start, times, *tolerances)
    return ErrorCurve(times, jax.vmap(symmetric.unpack)(error), jax.vmap(symmetric.unpack)(design))
