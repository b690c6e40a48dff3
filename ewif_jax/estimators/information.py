"""The Kalman filter in information form."""

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels import cholesky
from ewif_jax.models.linearise import need_linear, need_reversible
from ewif_jax.models.model import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import information as form
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.information import InformationState
from ewif_jax.recursions.invertible import refuse_one_way
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Params, RandomKey


@from_recipe
def information(model: Model) -> Estimator:
    r"""The Kalman filter on the information matrix, which may start from nothing.

    .. math::
        P_k^{-1} = A' (P_{k-1} + A Q A')^{-1} A + H' R^{-1} H \quad (33)

    with A back from k to k-1: Shulami & Sigalov, eqs. (32)-(33). Neither Q nor R nor the
    information matrix has to be invertible. `prior=None` as in `ewif`, and so an F that turns out
    singular inside a trace; late measurements as in `kalman`.

    Reduces to: `kalman` with the same prior.

    Deviations: (32)-(33) print Q with indices (k-1, k); it is the Q (k, k-1) of (31).

    Raises:
        ValueError: the model is not linear; a prior with a singular covariance; with
            `prior=None` a constant F without inverse.
    """
    need_linear(model, "information")

    def start(
        params: Params, prior: Gaussian | None, t0: Array, key: RandomKey
    ) -> InformationState:
        del key
        if prior is None:
            need_reversible(model, "information with prior=None")
            refuse_one_way(model, params, "information with prior=None")
        return form.start(model, params, prior, t0)

    def move(params: Params, state: InformationState, time: Array) -> InformationState:
        Q = jnp.asarray(model.process_cov(params, state.time, time), state.mean.dtype)
        checks.shape("Q", Q, (state.mean.shape[0],) * 2)
        # A root of Q with zero columns where Q is singular: noise enters as errors of unit variance
        # that these columns spread, so no inverse of Q is asked for.
        return form.transport(model, params, state, time, None, cholesky.factor(Q).lower)

    def measure(
        params: Params, state: InformationState, measurement: Measurement
    ) -> tuple[InformationState, Info]:
        return form.absorb(model, params, state, measurement, 1.0, exact=True)

    def estimate(params: Params, state: InformationState) -> Gaussian:
        del params
        return form.estimate(state)

    recursion = Recursion("information", start, move, measure, estimate, model=model)
    estimated = ("mean", "variances", "rows", "targets")
    recursion = recursion._replace(
        starts_from_nothing=True, inverts_prior=True, keeps=True, estimated=estimated
    )
    return estimator_from(recursion)
