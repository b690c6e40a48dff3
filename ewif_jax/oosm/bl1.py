"""Bl1: the one-step solution that leaves the process noise out."""

from ewif_jax.models import Model
from ewif_jax.oosm.history import one_step
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Estimator


@from_recipe
def bl1(model: Model, lag: int) -> Estimator:
    r"""The filter of `al1` that retrodicts as if there had been no process noise.

    .. math::
        \hat v = 0, \quad P_{vv} = Q, \quad P_{xv} = P(k|k) M^{-1} Q

    with Q = Q(k, d), M = P(k|k-l): Bar-Shalom, Chen & Mallick (2004); (71)-(86) of Pornsarayouth &
    Yamakita with (76) set to zero. The gain is the best one for that retrodiction.

    Args:
        model: linear or not; as for `al1`.
        lag: how many past update times are kept, >= 1. A measurement older than all of them, or
            than t0, is `TOO_LATE`.

    At one lag the covariance is that of its error; its error is never below that of `al1` there.

    Reduces to: `kalman` (or `extended`) at delay 0; `b1` for lag = 1.

    Raises:
        ValueError: lag < 1; `init` with `prior=None`.
    """
    return one_step(model, "bl1", lag, noise_estimated=False)
