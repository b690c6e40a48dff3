"""The Kalman filter on a square root of the covariance."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ewif_jax.kernels import cholesky, gaussian
from ewif_jax.kernels.triangular import is_some, root_of, small_held, triangularise
from ewif_jax.models.linearise import need_linear, predict_state
from ewif_jax.models.model import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.innovations import compared, info_of
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Params, RandomKey


class RootState(NamedTuple):
    """time (), mean (n,), root (n, n) lower triangular with P = root root'."""

    time: Array
    mean: Array
    root: Array


@from_recipe
def square_root(model: Model) -> Estimator:
    r"""The Kalman filter that carries a triangular root of P and never forms P.

    .. math::
        [F S,\; Q^{1/2}] \Theta = [S^-,\; 0], \qquad
        \begin{pmatrix} R^{1/2} & H S^- \\ 0 & S^- \end{pmatrix} \Theta =
        \begin{pmatrix} (H P^- H' + R)^{1/2} & 0 \\ K (H P^- H' + R)^{1/2} & S \end{pmatrix}

    (Potter; Kailath's array form), with orthogonal :math:`\Theta` by modified Gram-Schmidt. P is
    positive semidefinite by construction and float32 keeps twice the digits of P. Q, R and P may
    be singular or zero. But measuring exactly (a singular R) what is known exactly already is
    decided by rounding, of which a root has more than its square: use `kalman` there.

    Reduces to: `kalman`.

    Raises:
        ValueError: the model is not linear; `init` with `prior=None`.
    """
    need_linear(model, "square_root")

    def start(params: Params, prior: Gaussian, t0: Array, key: RandomKey) -> RootState:
        del params, key
        return RootState(t0, prior.mean, cholesky.factor(prior.cov).lower)

    def move(params: Params, state: RootState, time: Array) -> RootState:
        mean, F, Q = predict_state(model, params, state.mean, state.time, time)
        root = small_held(triangularise(jnp.concatenate([F @ state.root, root_of(Q)], 1)))
        # Made triangular again it would be the same but for its rounding.
        return RootState(time, mean, jnp.where(time > state.time, root, state.root))

    def measure(
        params: Params, state: RootState, measurement: Measurement
    ) -> tuple[RootState, Info]:
        difference, H, R, mask = compared(model, params, state.mean, measurement)
        m, n = H.shape
        seen = jnp.where(mask[:, None], H @ state.root, 0)
        noise = root_of(gaussian.mask_cov(R, mask))
        blank = jnp.zeros((n, m), R.dtype)
        # The square of this array is [[S, H P], [P H', P]]: its triangular root has S^(1/2) in the
        # corner, P H' S^(-T/2) below it, and the root of the updated P beside. P is never formed or
        # subtracted.
        array = triangularise(jnp.block([[noise, seen], [blank, state.root]]))
        lower, crossed, root = array[:m, :m], array[m:, :m], array[m:, m:]
        diagonal = jnp.diag(lower)
        positive = is_some(diagonal)
        reciprocal = jnp.where(positive, 1 / jnp.where(positive, diagonal, 1), 0)
        factor = cholesky.Factor(lower, reciprocal, jnp.all(positive))
        innovation = gaussian.Innovation(
            jnp.where(mask, difference, 0), lower @ lower.T, factor, seen
        )
        white = cholesky.forward(factor, innovation.value)
        updated = RootState(state.time, state.mean + crossed @ white, root)
        return updated, info_of(innovation, mask)

    def estimate(params: Params, state: RootState) -> Gaussian:
        del params
        return Gaussian(state.mean, state.root @ state.root.T)

    recursion = Recursion("square_root", start, move, measure, estimate, model=model)
    return estimator_from(recursion._replace(estimated=("mean", "root")))
