"""The accumulated state density: the joint Gaussian of now and the last update times."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.estimator import choose, verdict
from ewif_jax.forms.innovations import Compared, sound
from ewif_jax.kernels import gaussian, retrodiction, slots, symmetric
from ewif_jax.kernels.batched import kernel, total
from ewif_jax.kernels.small import matmul, matvec
from ewif_jax.models import Model, flow, sight
from ewif_jax.oosm.history import too_late
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status


class JointState(NamedTuple):
    """time (); used (): whether this time has taken a measurement; newest first, times (L,),
    means (L, n) and cov (L n, L n): the joint covariance."""

    time: Array
    used: Array
    times: Array
    means: Array
    cov: Array


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

    The joint covariance resolves what two neighbouring states do not have in common only down to
    the rounding of what they have. Where noise drives just the end of a chain of three or more
    integrators, its smallest variance is far below that: in the axes of the chain about 1e-7 is
    left of float64 for intervals of 0.01 among ones of 1, and in axes that mix the chain errors of
    1e-12 to 3e-2 of a unit were seen (3 and 4 states, one noise, intervals from 0.02 to 1).
    `replay` does not have this limit.

    Reduces to: `kalman` (or `extended`) in sequence; `replay` of it for a linear model.

    Raises:
        ValueError: lag < 1; `init` with `prior=None`.
    """
    checks.require(isinstance(model, Model), "model", "a Model", type(model).__name__)
    count = checks.whole("lag", lag, 1) + 1

    def init(params: Any, prior: Gaussian | None, t0: Any, key: Any = None) -> JointState:
        del params, key
        prior = checks.needs_prior(prior, "asd")
        checks.prior(prior)
        mean = jnp.asarray(prior.mean)
        cov = jnp.asarray(prior.cov, mean.dtype)
        time = jnp.asarray(t0, mean.dtype)
        times, means = jnp.stack([time] * count), jnp.stack([mean] * count)
        return JointState(time, jnp.asarray(False), times, means, jnp.tile(cov, (count, count)))

    def predict(params: Any, state: JointState, time: Array) -> JointState:
        time = jnp.asarray(time, state.time.dtype)
        ahead = jnp.maximum(time, state.time)
        mean, F, Q = flow(model, params, state.means[0], state.time, ahead)
        n = mean.shape[0]
        row = matmul(F, state.cov[:n])
        own = matmul(row[:, :n], F.T) + Q
        left = ahead > state.time
        first = jnp.arange(count) == 0
        moved = _placed(state, first, ~first & left & state.used, ahead, mean, row, own)
        known = time >= state.time
        return moved._replace(
            time=time,
            used=state.used & ~left,
            means=jnp.where(known, moved.means, jnp.nan),
            cov=jnp.where(known, moved.cov, jnp.nan),
        )

    def update(params: Any, state: JointState, measurement: Measurement) -> tuple[JointState, Info]:
        newer = jnp.sum(state.times > measurement.time)
        known = newer < count
        present = jnp.any(measurement.mask)
        usable = known & present
        mask = measurement.mask & usable
        at = jnp.arange(count) == jnp.where(known, newer, 0)
        joint = _with_time(model, params, state, at, measurement.time, usable)
        mean, row = slots.picked(joint.means, at), _row(joint.cov, at)
        predicted, H, R = sight(model, params, mean, measurement.sensor, measurement.time)
        checks.shape("measurement.value", measurement.value, (H.shape[0],))
        difference = model.residual(measurement.value, predicted, measurement.sensor)
        by_slot = row.T.reshape(count, -1, row.shape[0])
        cov = symmetric.pack(slots.picked(by_slot, at))
        (difference, H, R, mask), good = sound(model, cov, Compared(difference, H, R, mask))
        cross = matmul(H, row)
        own = slots.picked(cross.T.reshape(count, -1, H.shape[0]), at).T
        innovation = gaussian.innovate(difference, cross, matmul(own, H.T) + R, mask)
        weights = gaussian.gain(innovation).T
        half = _reduced(joint.cov, innovation.cross, weights)
        correction = matmul(gaussian.mask_cov(R, mask), weights) - matmul(H, _row(half, at))
        shift = matvec(weights.T, innovation.value)
        updated = joint._replace(
            used=state.used | usable,
            means=joint.means + shift.reshape(count, -1),
            cov=_joseph(half, weights, correction),
        )
        late = measurement.time < state.time
        info = Info(
            innovation.value,
            innovation.cov,
            gaussian.log_density(innovation, mask),
            state.time - measurement.time,
            verdict(late, present, Status.LATE_USED, good),
        )
        if model.linear is None:
            updated = choose(good, updated, state)
        return updated, too_late(info, ~known)

    def estimate(params: Any, state: JointState) -> Gaussian:
        del params
        n = state.means.shape[1]
        cov = state.cov[:n, :n]
        return Gaussian(state.means[0], (cov + cov.T) / 2)

    return Estimator(init, predict, update, estimate)


def _with_time(
    model: Model, params: Any, state: JointState, at: Array, time: Array, usable: Array
) -> JointState:
    """The joint with a state of `time` in the slot `at` (L,), whose present state is the last not
    newer; unchanged unless `usable`, or where that state is of this very time."""
    after = jnp.concatenate([at[:1] | at[1:2], at[2:], jnp.zeros(1, bool)])
    start, end = slots.picked(state.times, at), slots.picked(state.times, after)
    before_mean, after_mean = slots.picked(state.means, at), slots.picked(state.means, after)
    time = jnp.clip(time, start, end)
    there, F1, Q1 = flow(model, params, before_mean, start, time)
    arrived, F2, Q2 = flow(model, params, there, time, end)
    gain, left_over = retrodiction.bridge(Q1, F2, Q2)
    rest = F1 - matmul(matmul(gain, F2), F1)
    mean = there + matvec(gain, after_mean - arrived)
    row = matmul(gain, _row(state.cov, after)) + matmul(rest, _row(state.cov, at))
    by_slot = row.T.reshape(at.shape[0], -1, row.shape[0])
    own = matmul(gain, slots.picked(by_slot, after)) + matmul(rest, slots.picked(by_slot, at))
    push = usable & (time > start)
    older = jnp.cumsum(at) > at
    return _placed(state, at & push, older & push, time, mean, row, own + left_over)


def _placed(
    state: JointState, here: Array, older: Array, time: Array, mean: Array, row: Array, own: Array
) -> JointState:
    """The joint with a new state in the slot `here` (L,): mean (n,), covariances `row` (n, L n)
    with the old slots and `own` (n, n). The slots `older` (L,) take what was one slot newer."""
    return state._replace(
        times=_replaced(state.times, time, here, older),
        means=_replaced(state.means, mean, here, older),
        cov=_inserted(state.cov, row, own, here, older),
    )


def _row(cov: Array, at: Array) -> Array:
    """The rows (n, L n) of the joint covariance that belong to the slot `at` (L,)."""
    return slots.picked(cov.reshape(at.shape[0], -1, cov.shape[1]), at)


@kernel
def _replaced(table: Array, new: Array, here: Array, older: Array) -> Array:
    inner = (1,) * (table.ndim - here.ndim)

    def wide(flags: Array) -> Array:
        return flags.reshape(flags.shape[:1] + inner + flags.shape[1:])

    moved = jnp.where(wide(older), jnp.concatenate([table[:1], table[:-1]]), table)
    return jnp.where(wide(here), new[None], moved)


@kernel
def _inserted(cov: Array, row: Array, own: Array, here: Array, older: Array) -> Array:
    count, n, batch = here.shape[0], own.shape[0], cov.shape[2:]
    blocks = cov.reshape(count, n, count, n, *batch)
    across = row.reshape(n, count, n, *row.shape[2:])
    (here_down, older_down), (here_across, older_across) = (
        [x[:, None, None, None] for x in (here, older)],
        [x[None, None, :, None] for x in (here, older)],
    )
    blocks = jnp.where(older_down, jnp.concatenate([blocks[:1], blocks[:-1]]), blocks)
    blocks = jnp.where(
        older_across, jnp.concatenate([blocks[:, :, :1], blocks[:, :, :-1]], 2), blocks
    )
    across = jnp.where(older_across[0], jnp.concatenate([across[:, :1], across[:, :-1]], 1), across)
    across = jnp.where(here_across[0], own[:, None], across)
    down = jnp.moveaxis(across, (0, 1, 2), (2, 0, 1))
    blocks = jnp.where(here_across, down[:, :, None], blocks)
    blocks = jnp.where(here_down, across[None], blocks)
    return blocks.reshape(cov.shape[:2] + blocks.shape[4:])


@kernel
def _reduced(cov: Array, cross: Array, weights: Array) -> Array:
    """P - P H' K' with K' = weights."""
    return cov - total(w[:, None] * c[None] for w, c in zip(weights, cross, strict=True))


@kernel
def _joseph(half: Array, weights: Array, correction: Array) -> Array:
    """half + K correction, made symmetric."""
    whole = half + total(w[:, None] * c[None] for w, c in zip(weights, correction, strict=True))
    return (whole + jnp.swapaxes(whole, 0, 1)) / 2
