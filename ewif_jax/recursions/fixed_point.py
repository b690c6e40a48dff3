"""Fixed-point smoothing: what the state now says of the state at an earlier time."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax.fast.small import matmul, matvec
from ewif_jax.kernels import cholesky, symmetric
from ewif_jax.kernels.trees import choose
from ewif_jax.models import Model
from ewif_jax.models.angles import state_difference
from ewif_jax.recursions.covariance import CovarianceState
from ewif_jax.recursions.sigma_points import SigmaPoints, flow_around, measure_around
from ewif_jax.types import Gaussian, Measurement, Params


class Conditional(NamedTuple):
    """The density of x(tau) given x(now): N(mean + gain (x(now) - now), cov), with mean and now
    (n,), gain and cov (n, n)."""

    mean: Array
    gain: Array
    now: Array
    cov: Array


def fixed_point(
    model: Model,
    points: SigmaPoints | None,
    params: Params,
    start: CovarianceState,
    tau: Array,
    measurements: Measurement,
    now: Array,
) -> Conditional:
    r"""The density of x(tau) given any x(now) and all measurements older than `now`.

    .. math::
        p(x_\tau | x_k, y_{0:k-1}) = N(\hat x_\tau + G (x_k - \hat x_k),\;
            P_{\tau\tau} - G P_{k\tau}), \quad G = P_{\tau k} P_{kk}^{-1}

    (43)-(46) of Orguner & Gustafsson: the filter of the augmented state (36)-(38), whose second
    half stands still and is never seen, from `start`, the last summary not newer than tau, through
    the measurements after tau, and on to `now`; there x_k is a measurement, through (24), of the
    state at the last of these times (tau itself if nothing was measured since). One gain serves
    every x_k. Exact for a linear model.

    Args:
        points: of the unscented transform (UKS), or None: linearised (EKS).
        start: time (), mean (n,), cov (packed).
        measurements: (L,) in order of time; those not inside (tau, now) are passed over.

    Deviations: Remark 2 prints x(k-1) for x(tau) in (44), which is not the posterior.
    """
    n = start.mean.shape[0]

    def ahead(state: CovarianceState, time: Array, still: int) -> CovarianceState:
        """All but the last `still` components."""
        mean, cov = state.mean, state.cov
        moved, F, Q = flow_around(model, points, params, mean, cov, state.time, time, still)
        stands = jnp.append(jnp.zeros(F.shape[0], F.dtype), jnp.ones(still, F.dtype))
        # The augmented motion (36): the model's F for x(now), the identity for x(tau), no noise on
        # it.
        F = jnp.pad(F, (0, still)) + jnp.diag(stands)
        Q = jnp.pad(Q, (0, still))
        mean = jnp.concatenate([moved, mean[n:]])
        return CovarianceState(time, mean, symmetric.congruence(F, cov) + symmetric.pack(Q))

    def passed(
        state: CovarianceState, step: tuple[Measurement, Array]
    ) -> tuple[CovarianceState, None]:
        measurement, last = step
        inside = (measurement.time > tau) & (measurement.time < now)
        inside = inside & jnp.any(measurement.mask) & ~last
        time = jnp.where(last, now, jnp.where(inside, measurement.time, state.time))
        moved = ahead(state, time, n)
        mean, cov, _ = measure_around(model, points, params, moved.mean, moved.cov, measurement, n)
        measured = choose(inside, CovarianceState(time, mean, cov), state)
        return choose(last, moved, measured), None

    there = ahead(start, tau, 0)
    # At tau both halves are the same number: all four blocks of the covariance are P. It is
    # singular, which the update allows.
    twice = jnp.tile(symmetric.unpack(there.cov), (2, 2))
    first = CovarianceState(tau, jnp.tile(there.mean, 2), symmetric.pack(twice))
    # After the measurements once more, only to move on: a second copy would be compiled longer.
    steps = jax.tree.map(lambda x: jnp.concatenate([x, x[-1:]]), measurements)
    final = jnp.arange(steps.time.shape[0]) == measurements.time.shape[0]
    last = lax.scan(passed, first, (steps, final))[0]
    cov = symmetric.unpack(last.cov)
    # G' = P_kk^-1 P_k,tau by one triangular factor: what is explained, root' root, is then
    # symmetric and never more than P_tau,tau but for rounding.
    f = cholesky.factor(cov[:n, :n])
    root = cholesky.forward(f, cov[:n, n:])
    gain = cholesky.backward(f, root).T
    return Conditional(last.mean[n:], gain, last.mean[:n], cov[n:, n:] - matmul(root.T, root))


def given(model: Model, conditional: Conditional, x: Array) -> Gaussian:
    """The mean (n,) and covariance (n, n) of x(tau) if the state now is x (n,)."""
    mean, gain, now, cov = conditional
    return Gaussian(mean + matvec(gain, state_difference(model, x, now)), cov)
