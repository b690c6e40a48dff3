"""The iterated extended Kalman filter."""

import jax.numpy as jnp
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.fast.small import matvec
from ewif_jax.models.linearise import need_model
from ewif_jax.models.model import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.contract import estimator_from
from ewif_jax.recursions.covariance import CovarianceState, covariance_recursion
from ewif_jax.recursions.innovations import compared, updated
from ewif_jax.types import Estimator, Info, Measurement, Params, Status


@from_recipe
def iterated_extended(model: Model, iterations: int = 5) -> Estimator:
    r"""The extended Kalman filter whose update is so many Gauss-Newton steps.

    With :math:`x_0 = \hat x^-` and :math:`H_i = \partial h / \partial x |_{x_i}`

    .. math::
        K_i = P^- H_i' (H_i P^- H_i' + R)^{-1}, \quad
        x_{i+1} = \hat x^- + K_i \big( z - h(x_i) - H_i (\hat x^- - x_i) \big),

    after Bell & Cathey (1993, IEEE Trans. AC 38, 294): each step minimises

    .. math::
        (x - \hat x^-)' (P^-)^{-1} (x - \hat x^-) + (z - h(x))' R^{-1} (z - h(x))

    with h as a straight line around the last. The covariance is that of the last step's H. The
    steps are plain: where the measurement is strongly curved they may go past the minimum.
    Innovations go through `model.residual`, so angles wrap. Late measurements, masks and singular
    matrices as in `kalman`; to use late ones, `replay`.

    Args:
        model: linear or not.
        iterations: the number of steps, >= 1, the same for every measurement.

    `Info` is that of the prediction: the innovation at :math:`\hat x^-`, its covariance, and the
    log likelihood that `extended` gives. A measurement at which a step is not a number is
    `REJECTED`.

    Reduces to: `extended` for one iteration; `kalman` on a linear model; the minimum of the cost
        above for many, where they converge.

    Raises:
        ValueError: iterations < 1; `init` with `prior=None`.
    """
    need_model(model, "iterated_extended")
    more = checks.whole("iterations", iterations, 1) - 1
    recursion = covariance_recursion(model, "iterated_extended")
    if model.linear is not None or more == 0:
        return estimator_from(recursion)

    def measure(
        params: Params, state: CovarianceState, measurement: Measurement
    ) -> tuple[CovarianceState, Info]:
        prior, cov = state.mean, state.cov
        first, kept, info = updated(model, prior, cov, compared(model, params, prior, measurement))

        def step(_: Array, before: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            mean, _, good = before
            seen = compared(model, params, mean, measurement)
            seen = seen._replace(difference=seen.difference - matvec(seen.H, prior - mean))
            seen = seen._replace(mask=seen.mask & good)
            mean, packed, again = updated(model, prior, cov, seen)
            fine = good & (again.status == Status.USED) & jnp.all(jnp.isfinite(mean))
            # What runs away goes on from the prediction, so that nothing is computed from it.
            return jnp.where(fine, mean, prior), jnp.where(fine, packed, cov), fine

        begin = first, kept, info.status == Status.USED
        mean, cov, good = lax.fori_loop(0, more, step, begin)
        status = jnp.where(good, info.status, jnp.int32(Status.REJECTED))
        return CovarianceState(state.time, mean, cov), info._replace(status=status)

    return estimator_from(recursion._replace(measure=measure))
