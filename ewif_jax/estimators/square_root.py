"""The Kalman filter on a square root of the covariance."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels import cholesky, gaussian
from ewif_jax.kernels.trees import choose
from ewif_jax.kernels.triangular import triangularise
from ewif_jax.models.linearise import need_linear, predict_measurement, predict_state
from ewif_jax.models.model import Model
from ewif_jax.recursions.contract import verdict
from ewif_jax.types import Estimator, Gaussian, Info, Measurement


class RootState(NamedTuple):
    """time (), mean (n,), root (n, n) lower triangular with P = root root'."""

    time: Array
    mean: Array
    root: Array


def square_root(model: Model) -> Estimator:
    r"""The Kalman filter that carries a triangular root of P and never forms P.

    .. math::
        [F S,\; Q^{1/2}] \Theta = [S^-,\; 0], \qquad
        \begin{pmatrix} R^{1/2} & H S^- \\ 0 & S^- \end{pmatrix} \Theta =
        \begin{pmatrix} (H P^- H' + R)^{1/2} & 0 \\ K (H P^- H' + R)^{1/2} & S \end{pmatrix}

    (Potter; Kailath's array form), with orthogonal :math:`\Theta` by modified Gram-Schmidt. P is
    positive semidefinite by construction and float32 keeps twice the digits of P. Q, R and P may
    be singular or zero.

    Reduces to: `kalman`.

    Raises:
        ValueError: the model is not linear; `init` with `prior=None`.
    """
    need_linear(model, "square_root")

    def init(params: Any, prior: Gaussian | None, t0: Any, key: Any = None) -> RootState:
        del params, key
        prior = checks.needs_prior(prior, "square_root")
        checks.prior(prior)
        mean = jnp.asarray(prior.mean)
        root = cholesky.factor(jnp.asarray(prior.cov, mean.dtype)).lower
        return RootState(jnp.asarray(t0, mean.dtype), mean, root)

    def predict(params: Any, state: RootState, time: Array) -> RootState:
        time = jnp.asarray(time, state.time.dtype)
        ahead = jnp.maximum(time, state.time)
        mean, F, Q = predict_state(model, params, state.mean, state.time, ahead)
        root = triangularise(jnp.concatenate([F @ state.root, cholesky.factor(Q).lower], 1))
        known = time >= state.time
        return RootState(time, jnp.where(known, mean, jnp.nan), jnp.where(known, root, jnp.nan))

    def update(params: Any, state: RootState, measurement: Measurement) -> tuple[RootState, Info]:
        mask = measurement.mask
        late = measurement.time < state.time
        present = jnp.any(mask)
        predicted, H, R = predict_measurement(
            model, params, state.mean, measurement.sensor, measurement.time
        )
        m, n = H.shape
        checks.shape("measurement.value", measurement.value, (m,))
        difference = model.residual(measurement.value, predicted, measurement.sensor)
        difference = jnp.where(mask, difference, 0)
        seen = jnp.where(mask[:, None], H @ state.root, 0)
        noise = cholesky.factor(gaussian.mask_cov(R, mask)).lower
        blank = jnp.zeros((n, m), R.dtype)
        array = triangularise(jnp.block([[noise, seen], [blank, state.root]]))
        lower, crossed, root = array[:m, :m], array[m:, :m], array[m:, m:]
        diagonal = jnp.diag(lower)
        positive = diagonal > 0
        reciprocal = jnp.where(positive, 1 / jnp.where(positive, diagonal, 1), 0)
        f = cholesky.Factor(lower, reciprocal, jnp.all(positive))
        white = cholesky.forward(f, difference)
        used = present & ~late
        updated = RootState(state.time, state.mean + crossed @ white, root)
        innovation = gaussian.Innovation(difference, lower @ lower.T, f, seen)
        info = Info(
            difference,
            innovation.cov,
            jnp.where(used, gaussian.log_density(innovation, mask), 0),
            state.time - measurement.time,
            verdict(late, present),
        )
        return choose(used, updated, state), info

    def estimate(params: Any, state: RootState) -> Gaussian:
        del params
        return Gaussian(state.mean, state.root @ state.root.T)

    return Estimator(init, predict, update, estimate, model)
