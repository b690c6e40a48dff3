"""B1: the update with a measurement that is one lag late, process noise left out."""

from ewif_jax.models import Model
from ewif_jax.oosm.history import one_step
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
        model: linear or not; as for `a1`.

    Reduces to: `kalman` (or `extended`) at delay 0; `bl1` with lag 1.

    Raises:
        ValueError: `init` with `prior=None`.
    """
    return one_step(model, "b1", 1, noise_estimated=False)
