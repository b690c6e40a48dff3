"""The Kalman-Bucy filter, with or without exponential data weighting."""

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.analysis.anderson_continuous import ContinuousSystem, check_continuous
from ewif_jax.kernels import symmetric
from ewif_jax.streams import float_dtype
from ewif_jax.types import DTypeLike, Gaussian, Numbers, Parameter, Params


class Signal(NamedTuple):
    """A measured signal: time (S,) increasing seconds, value (S, m), linear in between."""

    time: Array
    value: Array


class Filtered(NamedTuple):
    """time (K,), mean (K, n), cov (K, n, n): Pi, and gain (K, n, m) = Pi H' R^-1."""

    time: Array
    mean: Array
    cov: Array
    gain: Array


def kalman_bucy(
    system: ContinuousSystem,
    params: Params,
    signal: Signal,
    *,
    prior: Gaussian,
    times: Numbers,
    fading_rate: Parameter = 0.0,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 65_536,
) -> Filtered:
    r"""Estimates at the given times from a measured signal.

    .. math::
        \dot{\hat x} &= F \hat x + \Pi H' R^{-1} (z - H \hat x) \quad (3\text{-}5), (4\text{-}3) \\
        \dot\Pi &= \Pi (F + \alpha I)' + (F + \alpha I) \Pi - \Pi H' R^{-1} H \Pi + G Q G'
            \quad (4\text{-}2)

    Anderson (1973), sections 3 and 4, with H for his H'. :math:`\Pi = e^{2 \int \alpha} P_\alpha`
    stays bounded where the :math:`P_\alpha` of (3-4) and its noise covariances do not, and gives
    the same estimate. Solved by diffrax (Tsitouras 5/4, adaptive) with its adjoint, so it is
    differentiable in `params`, the signal and the prior.

    Args:
        system: F, G, H, Q, R, each a constant or a function (params, t).
        params: what they are read from.
        signal: z, sampled; the estimate is driven by its linear interpolation.
        prior: Gaussian at times[0].
        times: (K,) increasing seconds within the signal; the first is the start.
        fading_rate: alpha >= 0 in 1/s, a constant or a function (params, t).
        rtol, atol: tolerances of the solver; default by dtype (1e-9 and 1e-11 in float64).
        max_steps: of the solver, which steps to every sample; exceeding it is an error.

    Raises:
        ValueError: shapes; times that do not increase or leave the signal; Q (at the start) not
            PSD, R not positive definite; fading_rate < 0; tolerances that are not positive.
        ImportError: diffrax is not installed.

    Reduces to: the filter without weighting for alpha = 0; `steady_state_continuous` as time grows.

    Deviations: alpha may vary with time, as the paper allows after (2-8).
    """
    need_diffrax()
    checks.prior(checks.needs_prior(prior, "kalman_bucy"))
    _check_times(signal, times)
    dtype = float_dtype(signal.value)
    begin = jnp.asarray(times, dtype)[0]
    state_size, value_size = np.shape(prior.mean)[0], np.shape(signal.value)[1]
    check_design(system, fading_rate, params, begin, state_size, value_size)
    check_solver(rtol, atol, max_steps)
    samples = Signal(jnp.asarray(signal.time, dtype), jnp.asarray(signal.value, dtype))
    functions, constants = split((*system, fading_rate), dtype)
    tolerances = (rtol, atol, max_steps)
    prior = Gaussian(jnp.asarray(prior.mean, dtype), jnp.asarray(prior.cov, dtype))
    times = jnp.asarray(times, dtype)
    return _kalman_bucy(functions, constants, params, samples, prior, times, tolerances)


@partial(jax.jit, static_argnames=("functions", "tolerances"))
def _kalman_bucy(
    functions: tuple,
    constants: tuple,
    params: Params,
    signal: Signal,
    prior: Gaussian,
    times: Array,
    tolerances: tuple,
) -> Filtered:
    at = matrices(functions, constants, params)

    def field(t: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        mean, cov = state[0], symmetric.unpack(state[1])
        now = at(t)
        K = now.gain(cov)
        z = jax.vmap(lambda v: jnp.interp(t, signal.time, v), in_axes=1)(signal.value)
        return now.F @ mean + K @ (z - now.H @ mean), symmetric.pack(now.slope(cov))

    # The covariance is integrated as its upper triangle: it stays symmetric, and the solver's error
    # control counts each number once.
    start = prior.mean, symmetric.pack(prior.cov)
    mean, packed = solve(field, start, times, *tolerances, kinks=signal.time)
    cov = jax.vmap(symmetric.unpack)(packed)
    gains = jax.vmap(lambda t, P: at(t).gain(P))(times, cov)
    return Filtered(times, mean, cov, gains)


class Instant(NamedTuple):
    """The matrices at one time; noise is G Q G'."""

    F: Array
    H: Array
    noise: Array
    R: Array
    fading_rate: Array

    def gain(self, cov: Array) -> Array:
        """Pi H' R^-1, (n, m)."""
        return jnp.linalg.solve(self.R, self.H @ cov).T

    def slope(self, cov: Array) -> Array:
        """The right-hand side of (4-2), (n, n)."""
        K = self.gain(cov)
        moved = self.F @ cov
        # (4-2): the weighting adds alpha I to F on both sides, which is 2 alpha Pi.
        return moved + moved.T + 2 * self.fading_rate * cov - K @ self.R @ K.T + self.noise


def need_diffrax() -> None:
    """Says what to install before anything is traced."""
    if find_spec("diffrax") is None:
        raise ImportError(
            "continuous-time filters need diffrax: pip install 'ewif_jax[continuous]'"
        )


def split(values: tuple, dtype: DTypeLike) -> tuple[tuple, tuple]:
    """The functions among `values` (None elsewhere), and the constants (None elsewhere)."""
    functions = tuple(x if callable(x) else None for x in values)
    return functions, tuple(None if callable(x) else jnp.asarray(x, dtype) for x in values)


def matrices(functions: tuple, constants: tuple, params: Params) -> Callable[[Array], Instant]:
    """F, G, H, Q, R and the fading rate, split, as a function of time."""

    def instant_at(t: Array) -> Instant:
        F, G, H, Q, R, rate = (
            jnp.asarray(f(params, t), t.dtype) if c is None else c
            for f, c in zip(functions, constants, strict=True)
        )
        return Instant(F, H, G @ Q @ G.T, R, rate)

    return instant_at


def solve(
    field: Callable[[Array, Any], Any],
    start: Numbers,
    times: Array,
    rtol: float | None,
    atol: float | None,
    max_steps: int,
    kinks: Array | None = None,
) -> Any:
    """The solution of d state / dt = field(t, state) at `times`, stacked, from `start` at the
    first of them. The solver steps exactly to `times` and to `kinks` of the field."""
    import diffrax

    double = times.dtype == jnp.float64
    tolerances = diffrax.PIDController(
        rtol=rtol or (1e-9 if double else 1e-5), atol=atol or (1e-11 if double else 1e-7)
    )
    # An adaptive step across a kink of the interpolated signal would be refused over and over until
    # it is tiny: the solver steps to each sample instead.
    stops = times if kinks is None else jnp.concatenate([times, kinks])
    stepping = diffrax.ClipStepSizeController(tolerances, step_ts=jnp.sort(stops))
    return diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: field(jnp.asarray(t), y)),
        diffrax.Tsit5(),
        times[0],
        times[-1],
        None,
        start,
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=stepping,
        max_steps=max_steps,
    ).ys


def check_design(
    system: ContinuousSystem,
    fading_rate: Parameter,
    params: Params,
    start: Array,
    n: int,
    m: Numbers = "m",
) -> None:
    """Refuses a filter's system and fading rate as they are at the `start`."""
    check_continuous("system", system, n, m, params=params, start=start)
    rate = fading_rate(params, start) if callable(fading_rate) else fading_rate
    checks.shape("fading_rate", rate, ())
    checks.at_least("fading_rate", rate, 0.0)


def check_solver(rtol: float | None, atol: float | None, max_steps: int) -> None:
    """Refuses settings that no solver can use."""
    for name, value in (("rtol", rtol), ("atol", atol)):
        if value is not None:
            checks.positive(name, value)
    checks.whole("max_steps", max_steps, 1)


def check_increasing(name: str, times: Numbers) -> None:
    """Refuses known times that are not finite, fewer than two, or do not increase."""
    value = checks.concrete_value(times)
    if value is not None:
        checks.finite(name, value)
        increasing = value.size > 1 and bool((value[1:] > value[:-1]).all())
        checks.require(increasing, name, "at least two increasing times", value)


def _check_times(signal: Signal, times: Numbers) -> None:
    checks.shape("signal.time", signal.time, ("S",))
    checks.shape("signal.value", signal.value, (np.shape(signal.time)[0], "m"))
    checks.finite("signal.value", signal.value)
    checks.shape("times", times, ("K",))
    check_increasing("times", times)
    check_increasing("signal.time", signal.time)
    known, samples = checks.concrete_value(times), checks.concrete_value(signal.time)
    if known is not None and samples is not None:
        inside = samples[0] <= known[0] and known[-1] <= samples[-1]
        checks.require(
            inside, "times", f"times within the signal's {samples[0]} to {samples[-1]}", known
        )
