"""Al1: the one-step solution for a late measurement several lags old."""

from ewif_jax.models import Model
from ewif_jax.oosm.parts.equivalent import noise_estimated
from ewif_jax.oosm.parts.history import one_step
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Estimator


@from_recipe
def al1(model: Model, lag: int) -> Estimator:
    r"""The Kalman filter that takes a late measurement in one step over up to `lag` update times.

    All the data since :math:`t_{k-l} \le t_d` count as one equivalent measurement of the present
    state, from which the process noise since :math:`t_d` is estimated:

    .. math::
        \hat v = Q M^{-1} (\hat x(k|k) - \hat x(k|k-l)), \quad
        P_{vv} = Q - Q (M^{-1} - M^{-1} P(k|k) M^{-1}) Q, \quad P_{xv} = P(k|k) M^{-1} Q

    with Q = Q(k, d), M = P(k|k-l): Bar-Shalom, Chen & Mallick (2004) as in (71)-(86) of
    Pornsarayouth & Yamakita. The cost does not depend on the delay. A nonlinear model is
    linearised along the way, innovations go through `model.residual`.

    Args:
        model: linear or not; its process noise must compose over parts of an interval. One that is
            not linear must allow motion back in time; where that is not finite, what is late is
            `REJECTED`.
        lag: how many past update times are kept, >= 1. A measurement older than all of them, or
            than t0, is `TOO_LATE`.

    At one lag the result is exact for a linear model, once per interval: a second late measurement
    of the same interval meets a state that has already seen the first. At several lags the data
    inside the lag are forgotten in the retrodiction: the covariance is optimistic, and the result
    can be worse than dropping. For a linear model it does not depend on the order of the late
    arrivals between two moves of the filter; any other is linearised anew at what the ones before
    have left.

    Reduces to: `kalman` (or `extended`) at delay 0; `a1` for lag = 1; the exact answer for one late
        measurement per interval, one lag old.

    Deviations: (84)-(85) invert a matrix that is singular whenever fewer numbers than states were
        measured since; here nothing but M is factored. (76) and (80) are written with the
        equivalent measurement. For a linear model whose motion back could grow exponentially it is
        :math:`\tilde H = H G,\; \tilde R = R + H (P_d - G F P_d) H'` with
        :math:`G = P_d F' M^{-1}`, which is the same where F has an inverse, and needs none.

    Raises:
        ValueError: lag < 1; `init` with `prior=None`.
    """
    return one_step(model, "al1", lag, noise_estimated)
