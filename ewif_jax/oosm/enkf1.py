"""EnKF1: late measurements through stored ensembles."""

from jax import Array

from ewif_jax.models import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.ensemble_history import Bracket, EnsembleHistory, delayed
from ewif_jax.types import Estimator, Params


@from_recipe
def enkf1(model: Model, members: int, lag: int) -> Estimator:
    r"""The ensemble filter that relates a late measurement to now through stored members.

    With :math:`t_a \le t_l \le t_b` the stored times around the measurement's,

    .. math::
        x_i(l|l) &\approx x_i(a|a) + \frac{t_l - t_a}{t_b - t_a} (x_i(b|b) - x_i(a|a)) \quad (26),
        \qquad z_i(l|l) = h(x_i(l|l)) + w_i \quad (27) \\
        x_i(k|l^+) &= x_i(k|k) + P_{xz}(k, l|k, l) P_{zz}(l|l)^{-1} (z(l) - z_i(l|l)) \quad (32)

    with the sample covariances (28)-(31): Pornsarayouth & Yamakita. Neither Jacobians nor motion
    back in time are needed. The newest interval may end with the present ensemble, updated or
    predicted (33).

    What was learned after :math:`t_l` does not reach :math:`x(l|l)`: fine one interval back, poor
    over many (the paper's conclusion too).

    Args:
        model: linear or not.
        members: N >= 2.
        lag: how many past update times are kept, >= 1. A measurement older than all of them, or
            than t0, is `TOO_LATE`.

    Reduces to: `ensemble` at delay 0, member by member. On linear models the ensemble's
        distribution tends to the Gaussian that the same steps give for infinitely many members
        (`tests/oracles/enkf.py`), at rate :math:`1/\sqrt N`; its covariance is the true error
        covariance only without interpolation and one interval back.

    Deviations: (32) prints the same innovation for all members, which never shrinks the ensemble;
        here each has its own. R takes the place of the sample covariance of w_i in (29), and each
        set of N draws is moved to mean zero. (10) prints the last factor transposed.

    Raises:
        ValueError: members < 2; lag < 1; `init` with `prior=None` or without a key.
    """

    def retrodict(
        params: Params, state: EnsembleHistory, bracket: Bracket, time: Array, key: Array
    ) -> Array:
        return bracket.there

    return delayed(model, "enkf1", members, lag, retrodict, forecasts=False)
