"""Bl1: the one-step solution that leaves the process noise out."""

from functools import partial

from ewif_jax.models import Model
from ewif_jax.models.linearise import need_reversible
from ewif_jax.oosm.parts.equivalent import moved_back
from ewif_jax.oosm.parts.history import one_step
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
        model: linear or not; it must allow motion back in time, and its process noise must compose
            over parts of an interval. Where motion back is not finite, what is late is `REJECTED`.
        lag: how many past update times are kept, >= 1. A measurement older than all of them, or
            than t0, is `TOO_LATE`.

    At one lag the covariance is that of its error; its error is never below that of `al1` there.

    Reduces to: `kalman` (or `extended`) at delay 0; `b1` for lag = 1.

    Raises:
        ValueError: lag < 1; a constant F without inverse; `init` with `prior=None`.
    """
    equivalent = partial(moved_back, noise_estimated=False)
    estimator = one_step(model, "bl1", lag, equivalent)
    need_reversible(model, "bl1")
    return estimator
