"""The Kalman filter in information form."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels import symmetric
from ewif_jax.models.linearise import affine_flow, need_linear, need_reversible
from ewif_jax.models.model import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import information as form
from ewif_jax.recursions.contract import verdict
from ewif_jax.recursions.information import InformationState
from ewif_jax.types import Estimator, Gaussian, Info, Measurement


@from_recipe
def information(model: Model) -> Estimator:
    r"""The Kalman filter on the information matrix, which may start from nothing.

    .. math::
        P_k^{-1} = A' (P_{k-1} + A Q A')^{-1} A + H' R^{-1} H \quad (33)

    with A back from k to k-1: Shulami & Sigalov, eqs. (32)-(33). The inner inverse is computed as
    :math:`(I + P_{k-1}^{-1} A Q A')^{-1} P_{k-1}^{-1}`, which needs neither Q nor the information
    matrix to be invertible. `prior=None` and late measurements as in `ewif` and `kalman`.

    Reduces to: `kalman` with the same prior.

    Deviations: (32)-(33) print Q with indices (k-1, k); it is the Q (k, k-1) of (31).

    Raises:
        ValueError: the model is not linear; a prior with a singular covariance.
    """
    need_linear(model, "information")
    need_reversible(model, "information")

    def init(params: Any, prior: Gaussian | None, t0: Any, key: Any = None) -> InformationState:
        del key
        return form.start(model, params, prior, t0)

    def predict(params: Any, state: InformationState, time: Array) -> InformationState:
        dtype = state.mean.dtype
        time = jnp.asarray(time, state.time.dtype)
        ahead = jnp.maximum(time, state.time)
        n = state.mean.shape[0]
        A, _ = affine_flow(model, params, ahead, state.time, dtype)
        checks.shape("F", A, (n, n))
        Q = jnp.asarray(model.process_cov(params, state.time, ahead), dtype)
        checks.shape("Q", Q, (n, n))
        matrix = symmetric.unpack(state.matrix)
        noisy = jnp.linalg.solve(
            jnp.eye(n, dtype=dtype) + matrix @ (A @ Q @ A.T),
            jnp.concatenate([matrix, state.vector[:, None]], 1),
        )
        blurred = state._replace(
            matrix=symmetric.pack((noisy[:, :-1] + noisy[:, :-1].T) / 2), vector=noisy[:, -1]
        )
        moved = form.transport(model, params, blurred, ahead, 1.0)
        known = time >= state.time
        moved = InformationState(*(jnp.where(known, leaf, jnp.nan) for leaf in moved))
        return moved._replace(time=time)

    def update(
        params: Any, state: InformationState, measurement: Measurement
    ) -> tuple[InformationState, Info]:
        late = measurement.time < state.time
        present = jnp.any(measurement.mask)
        here = measurement._replace(
            time=jnp.maximum(measurement.time, state.time), mask=measurement.mask & ~late
        )
        updated, info = form.absorb(model, params, state, here, 1.0)
        delay = state.time - measurement.time
        return updated, info._replace(delay=delay, status=verdict(late, present))

    def estimate(params: Any, state: InformationState) -> Gaussian:
        del params
        return form.settled(state)

    return Estimator(init, predict, update, estimate, model=model)
