"""B1: the update with a measurement that is one lag late, process noise left out."""

from functools import partial

from ewif_jax.models import Model
from ewif_jax.models.linearise import need_reversible
from ewif_jax.oosm.parts.equivalent import moved_back
from ewif_jax.oosm.parts.history import one_step
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Estimator


@from_recipe
def b1(model: Model) -> Estimator:
    r"""The filter of `a1` that retrodicts as if there had been no process noise.

    .. math::
        \hat v = 0, \quad P_{vv} = Q(k, d), \quad P_{xv} = P(k|k) P(k|k-1)^{-1} Q(k, d)

    in (74)-(79) of Pornsarayouth & Yamakita: Bar-Shalom (2002), after Hilton, Martin & Blair. Its
    covariance is that of its error. Measurements older than the last interval are `TOO_LATE`.

    Args:
        model: linear or not; it must allow motion back in time, and its process noise must compose
            over parts of an interval. Where motion back is not finite, what is late is `REJECTED`.

    Reduces to: `kalman` (or `extended`) at delay 0; `bl1` with lag 1.

    Raises:
        ValueError: a constant F without inverse; `init` with `prior=None`.
    """
    equivalent = partial(moved_back, noise_estimated=False)
    estimator = one_step(model, "b1", 1, equivalent)
    need_reversible(model, "b1")
    return estimator
