"""A1: the exact update with a measurement that is one lag late."""

from ewif_jax.models import Model
from ewif_jax.oosm.parts.equivalent import noise_estimated
from ewif_jax.oosm.parts.history import one_step
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Estimator


@from_recipe
def a1(model: Model) -> Estimator:
    r"""The Kalman filter that takes a measurement of the last interval exactly.

    .. math::
        \hat x(d|k) &= F(d, k) (\hat x(k|k) - \hat v) \quad (74), \qquad
        \hat v = Q H' S^{-1} \nu = Q P(k|k-1)^{-1} (\hat x(k|k) - \hat x(k|k-1)) \quad (76) \\
        P(d|k) &= F(d, k) (P(k|k) + P_{vv} - P_{xv} - P_{xv}') F(d, k)' \quad (79)

    with (80), (81), Q = Q(k, d), :math:`t_{k-1} \le t_d \le t_k`: Bar-Shalom (2002) as in
    Pornsarayouth & Yamakita, appendix. Older measurements are `TOO_LATE`. A nonlinear model is
    linearised.

    Args:
        model: linear or not; its process noise must compose over parts of an interval. One that is
            not linear must allow motion back in time; where that is not finite, what is late is
            `REJECTED`.

    Exact for a linear model and one late measurement per interval.

    Reduces to: `kalman` (or `extended`) at delay 0; `al1` with lag 1.

    Deviations: (76), (80) and (81) are written with the estimates at both ends of the interval, so
        that several measurements at t_k, or late ones taken before, need not be remembered. A
        linear model is not moved back where that could lose digits: as in `al1`.

    Raises:
        ValueError: `init` with `prior=None`.
    """
    return one_step(model, "a1", 1, noise_estimated)
