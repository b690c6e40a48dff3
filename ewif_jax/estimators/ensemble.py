"""The ensemble Kalman filter."""

from typing import Literal

from jax import Array

from ewif_jax import checks
from ewif_jax.models import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import ensembles
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.ensembles import EnsembleState
from ewif_jax.recursions.innovations import info_of
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Params

FORMS = ("stochastic", "square_root")


@from_recipe
def ensemble(
    model: Model, members: int, form: Literal["stochastic", "square_root"] = "stochastic"
) -> Estimator:
    r"""The Kalman filter whose moments are those of N members that move through the model.

    .. math::
        x_i^- = f(x_i) + v_i \quad (33), \qquad \hat x = \tfrac1N \textstyle\sum x_i, \quad
        P = \tfrac1{N-1} \textstyle\sum (x_i - \hat x)(x_i - \hat x)' \quad (18), (19)

    Pornsarayouth & Yamakita, with :math:`P_{xz}, P_{hh}` the sample covariances of the members with
    :math:`h(x_i)`, :math:`P_{zz} = P_{hh} + R` and the gain :math:`K = P_{xz} P_{zz}^{-1}`.

    * "stochastic": :math:`x_i \leftarrow x_i + K (z - h(x_i) - w_i)`, each member with its own
      measurement noise (Burgers, van Leeuwen & Evensen 1998), as
      :math:`x_i + K (\nu - (h(x_i) - \hat z) - w_i)` with one innovation :math:`\nu` for all.
    * "square_root": :math:`\hat x \leftarrow \hat x + K (z - \hat z)`, and the deviations by
      :math:`e_i \leftarrow e_i - P_{xz} L'^{-1} (L + G)^{-1} (h(x_i) - \hat z)` with
      :math:`P_{zz} = L L',\; R = G G'` (Andrews 1968; Whitaker & Hamill 2002), so that the sample
      covariance is :math:`P - K P_{zz} K'` exactly; for one number it is the ensemble transform
      filter. Only process noise is drawn.

    The innovation :math:`\nu` of the mean goes through `model.residual` once, so that an angle far
    from its prediction turns all members the same way; means of angles are relative to the
    measurement predicted at the mean. Late measurements, masks and singular Q, P and R as in
    `kalman`; what all members predict alike, to rounding, tells them nothing. The members are
    functions of `params` and of fixed random numbers, so gradients are those of one realisation.

    Args:
        model: linear or not; no derivative of it is needed.
        members: N >= 2; fewer than states, they stay in the space that they span.
        form: which of the two.

    The state holds the members (n, N) and two keys. Noise depends on the key, on the number of
    moves and on the sensor, not on what was measured: see `fuse_ensembles`.

    Reduces to: `kalman` on a linear model as N grows, at rate :math:`1/\sqrt N`.

    Deviations: R takes the place of the sample covariance of w_i in (29), and each set of N draws
        is moved to mean zero: both remove errors of order :math:`1/\sqrt N`.

    Raises:
        ValueError: members < 2; an unknown form; `init` with `prior=None` or without a key.
    """
    checks.require(isinstance(model, Model), "model", "a Model", type(model).__name__)
    count = checks.whole("members", members, 2)
    checks.require(form in FORMS, "form", f"one of {FORMS}", repr(form))

    def start(params: Params, prior: Gaussian, t0: Array, key: Array) -> EnsembleState:
        del params
        return ensembles.drawn(prior, t0, key, count)

    def move(params: Params, state: EnsembleState, time: Array) -> EnsembleState:
        return ensembles.moved_members(model, params, state, time)[0]

    def measure(
        params: Params, state: EnsembleState, measurement: Measurement
    ) -> tuple[EnsembleState, Info]:
        own, sight = ensembles.sight_keys(state.sight, measurement.sensor)
        looked = ensembles.look_of_ensemble(
            model, params, state.members, state.members, measurement
        )
        if form == "stochastic":
            members = ensembles.perturbed(state.members, looked, own)
        else:
            members = ensembles.transformed_members(state.members, looked)
        info = info_of(looked.innovation, looked.mask, looked.all_finite)
        return state._replace(members=members, sight=sight), info

    def estimate(params: Params, state: EnsembleState) -> Gaussian:
        del params
        return ensembles.sample_moments(state.members, model.state_angle)

    recursion = Recursion("ensemble", start, move, measure, estimate, model=model)
    return estimator_from(recursion._replace(draws=True, estimated=("members",)))
