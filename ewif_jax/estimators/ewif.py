"""The exponentially weighted information filter of Shulami & Sigalov."""

from collections.abc import Callable
from typing import Any, get_args

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels.growth import decayed, exponential, grown, reciprocal_square
from ewif_jax.models.entry import without_process_noise
from ewif_jax.models.linearise import need_linear, need_model, need_reversible
from ewif_jax.models.model import Model, resolve
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import information as form
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.directional import directional as forgetting_by_direction
from ewif_jax.recursions.information import InformationState
from ewif_jax.recursions.invertible import refuse_exact, refuse_one_way
from ewif_jax.recursions.linearised import Linearisation
from ewif_jax.recursions.lines import lines_of
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Parameter, Params, RandomKey


@from_recipe
def ewif(
    model: Model,
    tau: Parameter = None,
    *,
    weight: Callable[..., Array] | None = None,
    linearisation: Linearisation | None = None,
    directional: bool = False,
) -> Estimator:
    r"""The least-squares estimate in which a measurement of age s counts exp(-s / tau).

    .. math::
        P_k^{-1} &= W_{m,k}^2 A_{m,k}' P_m^{-1} A_{m,k}
            + W_{d,k}^2 A_{d,k}' H_d' R_d^{-1} H_d A_{d,k} \quad (19) \\
        \hat x_k &= P_k \left( W_{m,k}^2 A_{m,k}' P_m^{-1} \hat x_m
            + W_{d,k}^2 A_{d,k}' H_d' R_d^{-1} (y_d - H_d c_{d,k}) \right) \quad (18)

    with :math:`W_{l,k} = e^{-(t_k - t_l)/2\tau}` (25): Shulami & Sigalov, Theorem 5, of which the
    filter (26)-(27), late measurements (36)-(37), prediction (34)-(35) and fixed-lag smoothing
    (section VI-A) are cases. There is no process noise and no history: a measurement of any
    validity time is one update, the order of arrival does not matter, and the state may be moved
    to any time, earlier ones too.

    Args:
        model: a linear `Model`, or with `linearisation` any; its motion must allow t1 < t0, its
            process noise is ignored.
        tau: decay time in seconds, > 0, a number or a function of `params`.
        weight: instead, W(params, t_measurement, t_state) with W >= 0, W(t, t) = 1 and
            W(l, k) = W(l, m) W(m, k) (11a-c); W itself, not its square.
        linearisation: what takes the place of A and H in a model that is not linear (a linear
            one's matrices are used as they are): "extended", the derivatives at the current mean;
            or "sigma-points", the straight line through 2n points of the current covariance
            (cubature), with what the line leaves over added to R, or to the covariance after a
            motion.
        directional: forget only in the directions in which measurements come in (with tau).

    **Nonlinear models.** A late measurement is looked at once, from the current mean carried back
    to its time: A is the derivative of that motion, H that of the sensor there. What an earlier
    measurement said is not looked at again from a better mean. So Theorem 4 holds as far as the
    lines agree. Derivatives taken at the same points give the same estimate in any order; taken at
    others, one that differs to second order in the noise (in the law test by 0.12 of its standard
    deviation for measurements about one of theirs off, and by a quarter of that for half the
    noise). Sigma points spread with the covariance, which what came before decides: there the
    order always matters (0.4 of a standard deviation in that test). `prior=None` is refused,
    because there is no mean to draw a line at; after a gap that forgets everything the lines are
    derivatives, at where the last estimate has moved to.

    **Directional forgetting.** With `directional=True` nothing fades with time. A measurement in
    sequence forgets what it sees anew, and nothing else: of the information matrix I

    .. math::
        I \leftarrow I - (1 - w)\, I V' (V I V')^{-1} V I, \quad w = e^{-s/\tau},

    with V a basis of the rows of H and s the time since their directions were last seen (SIFt:
    Lai & Bernstein 2024, arXiv 2404.10844). A gap loses nothing, and a direction never seen keeps
    its prior. A late measurement is added, its R counting exp(age / tau) as much, and forgets
    nothing, so that its order matters. Directions are those of the state's coordinates: where a
    row of H mixes components, their units matter. What only the motion makes visible is never
    forgotten: of positions alone, a velocity is taken to be constant. So it is for numbers that
    stand nearly still (biases, gains, calibrations) and are seen some of the time; for a target
    that manoeuvres take the plain filter.

    `init` accepts `prior=None` (nothing is known about the state): `estimate` is then NaN until
    the measurements determine the state to rounding, and the log likelihood of the measurements up
    to there is 0. A prior counts as a measurement of the whole state at t0 and decays like one.
    After a gap so long that the weights underflow (88 tau in float32, 709 in float64) the estimate
    is NaN again, until new measurements determine the state; over shorter gaps one after the other
    variances grow up to a largest one. A state that the motion makes certain (stable, and faster
    than information decays) is known with a variance down to rounding of its component.

    A measurement without noise (a singular R) is refused if R is known, else `REJECTED`: an R that
    tends to 0 still weights such measurements among themselves. So is one whose way back has no
    finite numbers. A discrete F without inverse is refused if it is known. Inside a trace it is as
    right as any other while the state is determined; what is known of a part of the state cannot
    pass it: from there on the estimate is NaN, every measurement `REJECTED`, the log likelihood
    minus infinity.

    Reduces to: `kalman` without process noise as tau grows; `fading` with inflation exp(dt / tau)
        and Q = 0; least squares over all the data (8)-(9). With `linearisation`: the EWIF of the
        matrices if the model is linear; `extended` without process noise as tau grows (and
        `unscented`, for one state). With `directional`: the plain filter where every measurement
        sees every direction; without forgetting as tau grows.

    Deviations: known inputs enter both the transport of the old estimate and the residual of a
        late measurement (the paper sets them to zero after (10)). The covariance is the paper's P,
        which is not the covariance of the error under its model (3). SIFt forgets over one step
        whatever has passed, and leaves out directions of little excitation by a threshold of the
        user's; here a direction forgets over the time since it was seen, and is left out where it
        is rounding.

    Raises:
        ValueError: both or neither of `tau` and `weight`; a tau that is not one number > 0; a
            model that is not linear, without `linearisation`; `prior=None` with one; a singular R;
            a constant F without inverse; `directional` with a weight.
    """
    kind = _kind_of(model, linearisation)
    by_tau = not directional or weight is None
    checks.require(by_tau, "directional", "a `tau` and no `weight` to go with it", "a `weight`")
    need_reversible(model, "ewif")
    one = (tau is None) != (weight is None)
    checks.require(one, "tau", "one of `tau` and `weight`", (tau, weight))
    if tau is not None and not callable(tau):
        checks.positive_number("tau", tau)

    def start(
        params: Params, prior: Gaussian | None, t0: Array, key: RandomKey
    ) -> InformationState:
        del key
        if tau is not None:
            checks.positive_number("tau", resolve(tau, params))
        checks.require(
            kind is None or prior is not None,
            "prior",
            "a Gaussian: ewif of a nonlinear model needs a mean to linearise at",
            None,
        )
        refuse_exact(model, params, t0, "ewif")
        refuse_one_way(model, params, "ewif")
        return form.start(model, params, prior, t0)

    growing, lines = growth(tau, weight), lines_of(model, kind)

    def decay(params: Params, time: Array) -> Array:
        return jnp.asarray(checks.positive("tau", resolve(tau, params)), time.dtype)

    def move(params: Params, state: InformationState, time: Array) -> InformationState:
        def fade(variances: Array) -> Array:
            if tau is None:
                return grown(variances, growing(params, state.time, time))
            return decayed(variances, time - state.time, decay(params, time))

        return lines.transport(params, state, time, fade)

    def measure(
        params: Params, state: InformationState, measurement: Measurement
    ) -> tuple[InformationState, Info]:
        # W of a late measurement at the state's time: its R counts 1 / W^2 as much (36). Nothing
        # else is special about it, since without process noise a motion back is exact.
        faded = growing(params, measurement.time, state.time)
        found = lines.look(params, state, measurement, faded)
        return form.absorb_sight(state, found, measurement, faded)

    def estimate(params: Params, state: InformationState) -> Gaussian:
        del params
        return form.estimate(state)

    def any_time(params: Params, state: InformationState, time: Array) -> Array:
        del params, state
        return jnp.isfinite(time)

    recursion = Recursion("ewif", start, move, measure, estimate, any_time)
    recursion = recursion._replace(
        moves_back=True, starts_from_nothing=True, inverts_prior=True, keeps=True
    )
    recursion = recursion._replace(model=without_process_noise(model))
    if directional:
        recursion = forgetting_by_direction(recursion, lines, growing, decay)
    return estimator_from(recursion)


def _kind_of(model: Model, linearisation: Linearisation | None) -> Linearisation | None:
    """How the model is made linear, None if it is."""
    names = get_args(Linearisation)
    given = linearisation is None or linearisation in names
    checks.require(given, "linearisation", f"one of {names}, or None", repr(linearisation))
    if linearisation is None:
        need_linear(model, "ewif", "give `linearisation`, 'extended' or 'sigma-points',")
    need_model(model, "ewif")
    return None if model.linear is not None else linearisation


def growth(
    tau: Parameter, weight: Callable[..., Array] | None
) -> Callable[[Any, Array, Array], Array]:
    """What variances of time t count at time `now`: (params, t, now) -> 1 / W(t, now)^2."""

    def by_weight(params: Params, measured: Array, now: Array) -> Array:
        assert weight is not None
        return reciprocal_square(jnp.asarray(weight(params, measured, now), now.dtype))

    def by_decay(params: Params, measured: Array, now: Array) -> Array:
        decay = jnp.asarray(checks.positive_number("tau", resolve(tau, params)), now.dtype)
        return exponential(now - measured, decay.reshape(()))

    return by_decay if weight is None else by_weight
