"""The smoother as a reference for late measurements: back through every stored time."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from ewif_jax.fast.small import matmul, matvec
from ewif_jax.kernels import cholesky, symmetric
from ewif_jax.kernels.trees import choose
from ewif_jax.models import Model, predict_state
from ewif_jax.models.angles import state_difference
from ewif_jax.oosm.parts.history import HistoryState, one_step
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.covariance import CovarianceState
from ewif_jax.recursions.innovations import Compared, compared
from ewif_jax.types import Estimator, Measurement, Params


class Tie(NamedTuple):
    """How the state of an earlier time hangs on the present one, given the data:
    x(time) = mean + A (x_now - its mean) + e, e independent with covariance `cov` (packed)."""

    time: Array
    mean: Array
    A: Array
    cov: Array


@from_recipe
def rts_reference(model: Model, lag: int) -> Estimator:
    r"""The Kalman filter that smooths back to a late measurement's time, one stored time after
    the other.

    .. math::
        \hat x^s(j|k) &= \hat x(j|j) + G_j (\hat x^s(j+1|k) - \hat x(j+1|j)) \quad (93), \qquad
        G_j = P(j|j) F' P(j+1|j)^{-1} \\
        P^s(j|k) &= P(j|j) + G_j (P^s(j+1|k) - P(j+1|j)) G_j' \quad (94), \qquad
        P(k, j|k) = P(k, j+1|k) G_j'

    down to :math:`t_l`, where the last stored estimate before it is predicted; then (9) and (10).
    Pornsarayouth & Yamakita call it the RTS-based reference. The recursion is carried as
    :math:`x_j = \hat x^s_j + A_j (x_k - \hat x_k) + e_j` with :math:`A_j = G_j A_{j+1}` and
    :math:`\mathrm{cov}(e_j) = G_j \mathrm{cov}(e_{j+1}) G_j' + (I - G_j F) P(j|j) (I - G_j F)' +
    G_j Q G_j'`, a sum of positive semidefinite terms, which makes the late measurement one of the
    present state with :math:`\tilde H = H A_l,\; \tilde R = R + H \mathrm{cov}(e_l) H'`.

    The cost is that of `lag` smoothing steps for every measurement. Estimates are stored as in
    `al1`, and never rewritten.

    Args:
        model: linear or not (Jacobians at the filtered means); its process noise must compose over
            parts of an interval. Motion back in time is not needed.
        lag: how many past update times are kept, >= 1. A measurement older than all of them, or
            than t0, is `TOO_LATE`.

    Exact for a single late measurement of a linear model. A second one of a time before an earlier
    late measurement's arrival meets stored estimates that do not know that one.

    Reduces to: `kalman` (or `extended`) at delay 0; `a1` for lag = 1.

    Deviations: (94) prints the last factor transposed.

    Raises:
        ValueError: lag < 1; `init` with `prior=None`.
    """
    return one_step(model, "rts_reference", lag, smoothed_back)


def smoothed_back(
    model: Model,
    params: Params,
    state: HistoryState,
    start: CovarianceState,
    measurement: Measurement,
) -> tuple[Compared, bool]:
    """The measurement through the smoothed state of its time; it can always be used."""
    time = jnp.clip(measurement.time, start.time, state.time)
    tie = _tied_state(model, params, state, start, time)
    seen = compared(model, params, tie.mean, measurement)
    R = seen.R + matmul(matmul(seen.H, symmetric.unpack(tie.cov)), seen.H.T)
    return seen._replace(H=matmul(seen.H, tie.A), R=R), True


def _tied_state(
    model: Model, params: Params, state: HistoryState, start: CovarianceState, time: Array
) -> Tie:
    """The state at `time`, between `start` and now, tied to the present one."""

    def tied_back(tie: Tie, slot: CovarianceState) -> tuple[Tie, None]:
        return choose(slot.time > time, _one_step_behind(model, params, tie, slot), tie), None

    n = state.mean.shape[0]
    # The present is tied to itself by the identity and without error; every step back composes one
    # more G (`_one_step_behind`).
    now = Tie(state.time, state.mean, jnp.eye(n, dtype=state.mean.dtype), 0 * state.cov)
    nearest, _ = lax.scan(tied_back, now, state.past)
    mean, F, Q = predict_state(model, params, start.mean, start.time, time)
    cov = symmetric.congruence(F, start.cov) + symmetric.pack(Q)
    tie = _one_step_behind(model, params, nearest, CovarianceState(time, mean, cov))
    return choose(time < nearest.time, tie, nearest)


def _one_step_behind(model: Model, params: Params, tie: Tie, slot: CovarianceState) -> Tie:
    """One smoothing step from `tie` to the estimate `slot` of an earlier time."""
    end = jnp.maximum(tie.time, slot.time)
    predicted, F, Q = predict_state(model, params, slot.mean, slot.time, end)
    full = symmetric.unpack(slot.cov)
    cross = matmul(F, full)
    spread = matmul(cross, F.T) + Q
    G = cholesky.solved((spread + spread.T) / 2, cross).T
    # Sarkka's form of (94) for the part that the present state does not explain: squares only, so
    # that a singular Q or P costs nothing but a skipped pivot.
    rest = jnp.eye(G.shape[0], dtype=G.dtype) - matmul(G, F)
    cov = symmetric.congruence(G, tie.cov + symmetric.pack(Q))
    return Tie(
        slot.time,
        slot.mean + matvec(G, state_difference(model, tie.mean, predicted)),
        matmul(G, tie.A),
        cov + symmetric.congruence(rest, slot.cov),
    )
