"""The accumulated state density: the joint Gaussian of now and the last update times."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.estimator import choose, verdict
from ewif_jax.kernels import gaussian, retrodiction
from ewif_jax.models import Model, flow, sight
from ewif_jax.oosm.history import too_late
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status


class JointState(NamedTuple):
    """time (); used (): whether this time has taken a measurement; newest first, times (L,),
    means (L, n) and covs (L, L, n, n): covs[i, j] is the covariance of x(i) with x(j)."""

    time: Array
    used: Array
    times: Array
    means: Array
    covs: Array


def asd(model: Model, lag: int) -> Estimator:
    r"""The filter of the joint density of the states at the last `lag` + 1 distinct times.

    .. math::
        p(x_k, x_{k-1}, \ldots, x_{k-L} \mid Z)

    (Koch & Govaers 2011; a fixed-lag augmented state). A measurement of any of these times is one
    Kalman update of the joint state. One that lies between two of them, a < d < c, brings the
    state of its own time into the joint, which is

    .. math::
        x_d = F_{da} x_a + b_{da} + G (x_c - F_{ca} x_a - b_{ca}) + e, \quad
        G = Q_{da} F_{cd}' (F_{cd} Q_{da} F_{cd}' + Q_{cd})^{-1}, \quad
        \mathrm{cov}(e) = Q_{da} - G F_{cd} Q_{da}

    because nothing else is known about the inside of an interval; the oldest state leaves. So any
    number of late measurements in any order is used exactly, at a cost that does not depend on the
    delay: of order (lag n)^2, nothing is filtered again. A nonlinear model is linearised.

    Args:
        model: linear or not; its process noise must compose over parts of an interval. Motion back
            in time is not needed.
        lag: how many past times are kept, >= 1. A measurement older than all of them, or than t0,
            is `TOO_LATE`.

    The gain G is as well conditioned as the process noise of the interval: where noise drives only
    the end of a chain of integrators, an interval much shorter than the others costs digits (about
    1e-7 is left of float64 for three integrators and intervals of 0.01 among ones of 1); `replay`
    does not have this limit.

    Reduces to: `kalman` (or `extended`) in sequence; `replay` of it for a linear model.

    Raises:
        ValueError: lag < 1; `init` with `prior=None`.
    """
    checks.require(isinstance(model, Model), "model", "a Model", type(model).__name__)
    slots = checks.whole("lag", lag, 1) + 1

    def init(params: Any, prior: Gaussian | None, t0: Any, key: Any = None) -> JointState:
        del params, key
        prior = checks.needs_prior(prior, "asd")
        checks.prior(prior)
        mean = jnp.asarray(prior.mean)
        cov = jnp.asarray(prior.cov, mean.dtype)
        time = jnp.asarray(t0, mean.dtype)
        covs = jnp.stack([jnp.stack([cov] * slots)] * slots)
        times, means = jnp.stack([time] * slots), jnp.stack([mean] * slots)
        return JointState(time, jnp.asarray(False), times, means, covs)

    def predict(params: Any, state: JointState, time: Array) -> JointState:
        time = jnp.asarray(time, state.time.dtype)
        ahead = jnp.maximum(time, state.time)
        mean, F, Q = flow(model, params, state.means[0], state.time, ahead)
        row = jnp.einsum("ab,jbc->jac", F, state.covs[0])
        left = ahead > state.time
        now = jnp.zeros((), jnp.int32)
        own = row[0] @ F.T + Q
        moved = _placed(state, now, left & state.used, ahead, mean, row, own)
        known = time >= state.time
        return moved._replace(
            time=time,
            used=state.used & ~left,
            means=jnp.where(known, moved.means, jnp.nan),
            covs=jnp.where(known, moved.covs, jnp.nan),
        )

    def update(params: Any, state: JointState, measurement: Measurement) -> tuple[JointState, Info]:
        mask = measurement.mask
        newer = jnp.sum(state.times > measurement.time)
        known = newer < slots
        at = jnp.where(known, newer, 0)
        joint = _with_time(model, params, state, at, measurement.time)
        here = joint.covs[at]
        predicted, H, R = sight(
            model, params, joint.means[at], measurement.sensor, measurement.time
        )
        checks.shape("measurement.value", measurement.value, (H.shape[0],))
        difference = model.residual(measurement.value, predicted, measurement.sensor)
        cross = jnp.einsum("ma,jab->jmb", H, here)
        innovation = gaussian.innovate(difference, _columns(cross), cross[at] @ H.T + R, mask)
        gain = _blocks(gaussian.gain(innovation), slots)
        means = joint.means + gain @ innovation.value
        covs = _joseph(joint.covs, gain, innovation.cross, at, H, gaussian.mask_cov(R, mask))
        updated = joint._replace(used=jnp.asarray(True), means=means, covs=covs)
        late = measurement.time < state.time
        present = jnp.any(mask)
        info = Info(
            innovation.value,
            innovation.cov,
            jnp.where(present, gaussian.log_density(innovation, mask), 0),
            state.time - measurement.time,
            verdict(late, present, Status.LATE_USED),
        )
        return choose(known & present, updated, state), too_late(info, ~known)

    def estimate(params: Any, state: JointState) -> Gaussian:
        del params
        return Gaussian(state.means[0], state.covs[0, 0])

    return Estimator(init, predict, update, estimate)


def _with_time(model: Model, params: Any, state: JointState, at: Array, time: Array) -> JointState:
    """The joint with a state of `time` in slot `at`, whose present state is the last not newer."""
    before, after = at, jnp.maximum(at - 1, 0)
    start, end = state.times[before], state.times[after]
    time = jnp.clip(time, start, end)
    there, F1, Q1 = flow(model, params, state.means[before], start, time)
    arrived, F2, Q2 = flow(model, params, there, time, end)
    gain, left_over = retrodiction.bridge(Q1, F2, Q2)
    rest = F1 - gain @ F2 @ F1
    mean = there + gain @ (state.means[after] - arrived)
    row = jnp.einsum("ab,jbc->jac", gain, state.covs[after]) + jnp.einsum(
        "ab,jbc->jac", rest, state.covs[before]
    )
    own = gain @ row[after].T + rest @ row[before].T + left_over
    return _placed(state, at, time > start, time, mean, row, own)


def _placed(
    state: JointState, at: Array, push: Array, time: Array, mean: Array, row: Array, own: Array
) -> JointState:
    """The joint with a new state in slot `at`: mean (n,), covariances `row` (L, n, n) with the old
    slots and `own` (n, n). It pushes the older slots back by one, or replaces the slot."""
    index = jnp.arange(state.times.shape[0])
    source = jnp.where(push & (index > at), index - 1, index)
    here = index == at
    row = jnp.where(here[:, None, None], own[None], row[source])
    covs = state.covs[source][:, source]
    covs = jnp.where(here[None, :, None, None], row.transpose(0, 2, 1)[:, None], covs)
    covs = jnp.where(here[:, None, None, None], row[None], covs)
    return state._replace(
        times=jnp.where(here, time, state.times[source]),
        means=jnp.where(here[:, None], mean[None], state.means[source]),
        covs=covs,
    )


def _joseph(covs: Array, gain: Array, cross: Array, at: Array, H: Array, R: Array) -> Array:
    """(I - K H) P (I - K H)' + K R K' block by block, H looking at slot `at`; cross (m, L n)."""
    seen = _blocks(cross.T, covs.shape[0])
    half = covs - jnp.einsum("iam,jbm->ijab", gain, seen)
    correction = gain @ R - half[:, at] @ H.T
    whole = half + jnp.einsum("iam,jbm->ijab", correction, gain)
    return (whole + whole.transpose(1, 0, 3, 2)) / 2


def _columns(blocks: Array) -> Array:
    """(m, L n) of (L, m, n)."""
    return jnp.concatenate(list(blocks), 1)


def _blocks(rows: Array, slots: int) -> Array:
    """(L, n, m) of (L n, m)."""
    return rows.reshape(slots, -1, rows.shape[1])
