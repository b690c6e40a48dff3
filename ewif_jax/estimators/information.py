"""The Kalman filter in information form."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels import cholesky
from ewif_jax.models.model import Model, need_linear
from ewif_jax.recursions import information as form
from ewif_jax.recursions.contract import verdict
from ewif_jax.recursions.information import InformationState
from ewif_jax.types import Estimator, Gaussian, Info, Measurement


def information(model: Model) -> Estimator:
    r"""The Kalman filter on the information matrix, which may start from nothing.

    .. math::
        P_k^{-1} = A' (P_{k-1} + A Q A')^{-1} A + H' R^{-1} H \quad (33)

    with A back from k to k-1: Shulami & Sigalov, eqs. (32)-(33). Neither Q nor R nor the
    information matrix has to be invertible. `prior=None` as in `ewif`, late measurements as in
    `kalman`.

    Reduces to: `kalman` with the same prior.

    Deviations: (32)-(33) print Q with indices (k-1, k); it is the Q (k, k-1) of (31).

    Raises:
        ValueError: the model is not linear; a prior with a singular covariance; with
            `prior=None` a constant F without inverse.
    """
    need_linear(model, "information")

    def init(params: Any, prior: Gaussian | None, t0: Any, key: Any = None) -> InformationState:
        del key
        if prior is None:
            form.refuse_one_way(model, params, "information with prior=None")
        return form.start(model, params, prior, t0)

    def predict(params: Any, state: InformationState, time: Array) -> InformationState:
        dtype = state.mean.dtype
        time = jnp.asarray(time, state.time.dtype)
        ahead = jnp.maximum(time, state.time)
        Q = jnp.asarray(model.process_cov(params, state.time, ahead), dtype)
        checks.shape("Q", Q, (state.mean.shape[0],) * 2)
        noise = cholesky.factor(Q).lower
        moved = form.transport(model, params, state, ahead, 1.0, noise)
        in_order = time >= state.time
        moved = jax.tree.map(lambda leaf: jnp.where(in_order, leaf, jnp.nan), moved)
        return moved._replace(time=time)

    def update(
        params: Any, state: InformationState, measurement: Measurement
    ) -> tuple[InformationState, Info]:
        late = measurement.time < state.time
        present = jnp.any(measurement.mask)
        here = measurement._replace(
            time=jnp.maximum(measurement.time, state.time), mask=measurement.mask & ~late
        )
        updated, info, good = form.absorb(model, params, state, here, 1.0, exact=True)
        delay = state.time - measurement.time
        return updated, info._replace(delay=delay, status=verdict(late, present, good=good))

    def estimate(params: Any, state: InformationState) -> Gaussian:
        del params
        return form.estimate(state)

    return Estimator(init, predict, update, estimate)
