"""The unscented Kalman filter, and the Gauss-Hermite filter."""

from typing import Literal

from jax import Array

from ewif_jax import checks
from ewif_jax.kernels import symmetric
from ewif_jax.kernels.trees import choose
from ewif_jax.models import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.covariance import CovarianceState
from ewif_jax.recursions.sigma_points import (
    GaussHermite,
    Points,
    SigmaPoints,
    check_points,
    measure_around,
    move_around,
)
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Parameter, Params, RandomKey


@from_recipe
def unscented(
    model: Model,
    ut_alpha: Parameter = 1.0,
    ut_beta: Parameter = 0.0,
    ut_kappa: Parameter = 0.0,
    *,
    points: Literal["unscented", "gauss-hermite"] = "unscented",
    order: int | None = None,
) -> Estimator:
    r"""The Kalman filter whose moments come from points of the model, not from Jacobians.

    With :math:`P = L L'`, :math:`c = \alpha^2 (n + \kappa)`, points
    :math:`x_0 = \hat x,\; x_{\pm j} = \hat x \pm \sqrt c\, L_j` and values :math:`y = f(x)`,

    .. math::
        \hat y &= y_0 + \tfrac{1}{2c} \textstyle\sum_j (y_j - y_0), \qquad
        P_{xy} = \tfrac{1}{2c} \textstyle\sum_j (x_j - \hat x)(y_j - \hat y)' \\
        P_{yy} &= \tfrac{1}{2c} \textstyle\sum_j (y_j - \hat y)(y_j - \hat y)'
            + (2 - n/c - \alpha^2 + \beta)(y_0 - \hat y)(y_0 - \hat y)'

    to which Q or R is added (Julier & Uhlmann 2004; van der Merwe 2004): noise is additive. New
    points are drawn for every prediction and for every measurement. Measurements are compared with
    the one predicted at the mean through `model.residual`, so bearings around :math:`\pm\pi` have
    the right mean. A linear model's moments are those of its matrices, without points. In a
    nonlinear one covariances are kept as sums of squares, so that no variance is below zero where
    all weights are positive. Late measurements, masks and singular matrices as in `kalman`.

    Args:
        model: linear or not; no derivative of it is needed.
        ut_alpha: spread of the points, > 0, a number or a function of `params`.
        ut_beta: weight for what is known about the distribution; 2 is best for a scalar Gaussian.
        ut_kappa: second spread, > -n.
        points: "unscented", the 2n + 1 points above; or "gauss-hermite", `order` points along each
            axis in every combination (Ito & Xiong 2000, IEEE Trans. AC 45, 910), which have no
            settings ut_*.
        order: points along an axis of the latter, >= 2 (default 3): means are exact where f is a
            polynomial of degree 2 order - 1 in each component, covariances to half of that. There
            are order^n of them, 20000 at most.

    The default, :math:`\alpha = 1, \beta = \kappa = 0`, is the cubature filter (Arasaratnam &
    Haykin 2009): all weights are positive, so the covariances are positive semidefinite, as they
    are for every setting with :math:`2 - n/c - \alpha^2 + \beta \ge 0`.

    Reduces to: `kalman` on a linear model; for one state, "gauss-hermite" of order 3 to
        ut_kappa = 2.

    Raises:
        ValueError: `init` with `prior=None`; ut_alpha <= 0; ut_kappa <= -n; points so close
            together that the dtype cannot tell their values apart (ut_alpha = 1e-3 in float32);
            an order < 2, or of too many points; an order of "unscented", or ut_* of
            "gauss-hermite".
    """
    checks.require(isinstance(model, Model), "model", "a Model", type(model).__name__)
    chosen = _chosen_points(points, order, SigmaPoints(ut_alpha, ut_beta, ut_kappa))

    def start(params: Params, prior: Gaussian, t0: Array, key: RandomKey) -> CovarianceState:
        del key
        check_points(chosen, params, prior.mean.shape[0], prior.mean.dtype)
        return CovarianceState(t0, prior.mean, symmetric.pack(prior.cov))

    def move(params: Params, state: CovarianceState, time: Array) -> CovarianceState:
        mean, cov = move_around(model, chosen, params, state.mean, state.cov, state.time, time)
        # Points drawn to stand still would round what they stand for.
        return choose(time > state.time, CovarianceState(time, mean, cov), state)

    def measure(
        params: Params, state: CovarianceState, measurement: Measurement
    ) -> tuple[CovarianceState, Info]:
        mean, cov, info = measure_around(model, chosen, params, state.mean, state.cov, measurement)
        return CovarianceState(state.time, mean, cov), info

    def estimate(params: Params, state: CovarianceState) -> Gaussian:
        del params
        return Gaussian(state.mean, symmetric.unpack(symmetric.no_negative(state.cov)))

    return estimator_from(Recursion("unscented", start, move, measure, estimate, model=model))


def _chosen_points(points: str, order: int | None, settings: SigmaPoints) -> Points:
    if points == "unscented":
        checks.require(order is None, "order", "nothing unless points='gauss-hermite'", order)
        return settings
    offered = points == "gauss-hermite"
    checks.require(offered, "points", "'unscented' or 'gauss-hermite'", repr(points))
    is_default = settings == SigmaPoints()
    checks.require(is_default, "ut_alpha", "no settings ut_* for points='gauss-hermite'", settings)
    return GaussHermite(checks.whole("order", 3 if order is None else order, 2))
