"""EnKF2: late measurements through stored ensembles, stepped back from now at once."""

from typing import Literal

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.models import Model
from ewif_jax.models.angles import wrapped_state
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import ensembles
from ewif_jax.recursions.ensemble_history import Bracket, EnsembleHistory, delayed
from ewif_jax.types import Estimator, Params

NOISES = ("fresh", "shared")


@from_recipe
def enkf2(
    model: Model, members: int, lag: int, noise: Literal["fresh", "shared"] = "fresh"
) -> Estimator:
    r"""`enkf1` with one step back that brings what was learned since to the measurement's time.

    .. math::
        x_i(k|l) &= f(x_i(l|l)) + v_i, \qquad
        d_i = x_i(k|k) - x_i(k|l) \quad (49) \\
        x_i(l|k) &= x_i(l|l) - P_{xd} P_{dd}^{-1} d_i \quad (47), (48), (50), (51)

    and :math:`x_i(l|k)` in place of :math:`x_i(l|l)` in (27): Pornsarayouth & Yamakita, section 4.
    The cost does not depend on the delay.

    Args:
        model: linear or not; motion back in time is not needed.
        members: N >= 2.
        lag: how many past update times are kept, >= 1. A measurement older than all of them, or
            than t0, is `TOO_LATE`.
        noise: "fresh": v_i is drawn anew, as in the paper. "shared": it is the noise that member i
            has met since t_l, so that d_i holds only what measurements did. This keeps and moves a
            forecast of every stored ensemble (twice the storage, and `lag` + 1 times the motion)
            and is clearly better over several intervals.

    Reduces to: `ensemble` at delay 0, member by member. On linear models the ensemble's
        distribution tends to the Gaussian that the same steps give for infinitely many members
        (`tests/oracles/enkf.py`), at rate :math:`1/\sqrt N`.

    Deviations: (47) prints a plus; minus is what (34)-(38) and the minimum of the variance ask for.
        (47) leaves out the process noise in x(k|l). P_dd is singular where less than the whole
        state was measured since t_l: directions without variance are skipped. The rest as in
        `enkf1`.

    Raises:
        ValueError: members < 2; lag < 1; an unknown noise; `init` with `prior=None` or without a
            key.
    """
    checks.require(noise in NOISES, "noise", f"one of {NOISES}", repr(noise))

    def retrodict(
        params: Params, state: EnsembleHistory, bracket: Bracket, time: Array, key: Array
    ) -> Array:
        there, ahead, now = bracket.there, bracket.ahead, state.members
        if ahead is None:
            drawn = ensembles.process_noise(model, params, key, there, time, state.time)
            ahead = ensembles.carried_members(model, params, there, time, state.time) + drawn
        apart = wrapped_state(model.state_angle, now - ahead)
        return ensembles.uncorrelated(there, _beyond_rounding(apart, now), model.state_angle)

    return delayed(model, "enkf2", members, lag, retrodict, forecasts=noise == "shared")


def _beyond_rounding(d: Array, x: Array) -> Array:
    """The differences d (n, N), zero in rows where they are only the rounding errors of x (n, N):
    a regression on these would be a regression on noise."""
    smallest = 64 * jnp.finfo(d.dtype).eps * jnp.max(jnp.abs(x), 1, keepdims=True)
    return jnp.where(jnp.max(jnp.abs(d), 1, keepdims=True) > smallest, d, 0)
