"""Interacting multiple models: one filter for each way in which a target may move."""

from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels import gaussian
from ewif_jax.kernels.trees import choose
from ewif_jax.models import Model, resolve
from ewif_jax.models.angles import Angles
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.mixtures import (
    log_of,
    log_sum,
    mixed_moments,
    normalised_weights,
    passed_on,
    together,
)
from ewif_jax.recursions.modes import (
    chain_of,
    check_members,
    check_probabilities,
    joint_model,
    mixed_angles,
)
from ewif_jax.types import (
    Estimator,
    Gaussian,
    Info,
    Measurement,
    Parameter,
    Params,
    RandomKey,
    Status,
)


class ModesState(NamedTuple):
    """time (), members: the state of each of M filters, log_probabilities (M,) of their models."""

    time: Array
    members: tuple[Any, ...]
    log_probabilities: Array


@from_recipe
def imm(
    estimators: Sequence[Estimator],
    transition: Parameter,
    probabilities: Parameter = None,
    *,
    dt: float = 1.0,
    max_steps: int = 1023,
) -> Estimator:
    r"""M filters, one for each model, mixed by how likely the target has changed between models.

    Over an interval with :math:`\Pi_{ij}` = probability of model j at its end after i at its start,

    .. math::
        c_j &= \sum_i \Pi_{ij} \mu_i, \quad \mu_{i|j} = \Pi_{ij} \mu_i / c_j, \quad
            \hat x_{0j} = \sum_i \mu_{i|j} \hat x_i, \quad
            P_{0j} = \sum_i \mu_{i|j} \big( P_i + (\hat x_i - \hat x_{0j})(\cdot)' \big) \\
        \mu_j &\propto c_j\, p_j(z), \quad \log p(z) = \log \sum_j c_j\, p_j(z), \quad
            \hat x = \sum_j \mu_j \hat x_j, \quad
            P = \sum_j \mu_j \big( P_j + (\hat x_j - \hat x)(\cdot)' \big)

    Blom & Bar-Shalom (1988). Mixing is a part of `predict`: once, for the whole interval between
    two measurements. So splitting an interval makes another filter (a closer one, if models change
    at any time); what `run(times=)` and `forecast` report is predicted from a copy, and never
    mixes the state that is kept. With `clock="arrival"` the filter itself moves, and mixes, at
    each of these times.

    Args:
        estimators: filters of one state whose own state is one mean and covariance: `kalman`,
            `extended`, `unscented`, `information`, `square_root`, `fading`, `ewif`; `robust` of
            these; any other whose state has these fields, since mixed moments enter by its `init`.
        transition: function (params, t0, t1) -> (M, M), rows of sum 1; or for one step of `dt`
            seconds, (M, M) or a function of `params` alone: then to the power of the steps, and
            times are whole steps, as for a discrete model. The identity goes with any interval.
        probabilities: (M,) at t0, numbers or a function of `params`; default: equal.
        dt: seconds of one step, a number > 0.
        max_steps: how many steps may be asked for at once.

    Angles of the state (`Model.state_angle` of models that are not linear) are mixed on the circle.

    `Info` is the mixture's: innovation and its covariance are its moments before the update, the
    log likelihood is the logarithm above. A model in which a measurement is impossible, or not a
    number, gets probability 0; if that is so in all, the probabilities stay. A late measurement is
    not used (`TOO_LATE`): `replay(imm(...), lag)` uses it exactly.

    A target that cruises, and now and then accelerates. The first model has the state of the
    second, in which the acceleration decays at once and drives nothing::

        import numpy as np
        import ewif_jax as ej

        sensor = ej.models.position_sensor(1.0)
        coast = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -5.0]])
        cruise = ej.models.from_continuous(coast, np.eye(3), [0.0, 1e-3, 1e-3], sensor)
        turn = ej.models.constant_acceleration(sensors=sensor, q=1.0)
        change = np.array([[0.95, 0.05], [0.10, 0.90]])
        modes = ej.imm([ej.kalman(cruise), ej.kalman(turn)], change)
        time = np.arange(1.0, 31.0)
        path = np.where(time < 20, 5 * time, 5 * time + 2 * (time - 20) ** 2)
        prior = ej.Gaussian(np.zeros(3), np.diag([10.0, 50.0, 1.0]))
        early = ej.stream(time[:19], path[:19, None])
        trace = ej.run(modes, None, early, prior=prior, t0=0.0)
        print(ej.imm_probabilities(trace.final_state).round(1))  # [0.9 0.1]
        trace = ej.run(modes, None, ej.stream(time, path[:, None]), prior=prior, t0=0.0)
        print(ej.imm_probabilities(trace.final_state).round(1))  # [0.1 0.9]

    Reduces to: the filter itself where all are equal; filter j with probabilities (0, .., 1, .., 0)
        and the identity.

    Raises:
        ValueError: no estimators; states of other kinds or sizes; a transition whose rows, or
            probabilities whose sum, are not 1; models in steps that differ; `init` with
            `prior=None`.
    """
    good = isinstance(estimators, tuple) and all(isinstance(e, Estimator) for e in estimators)
    kind = type(estimators).__name__
    checks.require(good and len(estimators) > 0, "estimators", "a sequence of Estimators", kind)
    count = len(estimators)
    chain = chain_of(transition, count, dt, max_steps)
    if probabilities is not None and not callable(probabilities):
        check_probabilities(probabilities, count)
    model = joint_model(estimators, chain, count)
    angle = None if model is None else mixed_angles(estimators)

    def start(params: Params, prior: Gaussian, t0: Array, key: RandomKey) -> ModesState:
        del key
        check_members(estimators, params, prior, t0)
        weights = jnp.full(count, 1 / count, t0.dtype)
        if probabilities is not None:
            given = check_probabilities(resolve(probabilities, params), count)
            weights = jnp.asarray(given, t0.dtype)
        members = tuple(e.init(params, prior, t0) for e in estimators)
        return ModesState(t0, members, log_of(weights))

    def move(params: Params, state: ModesState, time: Array) -> ModesState:
        end = jnp.maximum(time, state.time)
        chances = jnp.asarray(chain.chances(params, state.time, end), state.time.dtype)
        met = _mixed_members(estimators, params, state, chances, angle)
        met = choose(time > state.time, met, state)
        pairs = zip(estimators, met.members, strict=True)
        members = tuple(e.predict(params, own, time) for e, own in pairs)
        return ModesState(time, members, met.log_probabilities)

    def measure(
        params: Params, state: ModesState, measurement: Measurement
    ) -> tuple[ModesState, Info]:
        pairs = zip(estimators, state.members, strict=True)
        members, infos = zip(*(e.update(params, s, measurement) for e, s in pairs), strict=True)
        every_awake = [info.status == Status.USED for info in infos]
        is_awake = together(*(x.astype(state.time.dtype) for x in every_awake)) > 0
        before = jnp.where(is_awake, state.log_probabilities, -jnp.inf)
        told = together(*(info.log_likelihood for info in infos))
        joint = before + jnp.where(is_awake, told, 0)
        total = log_sum(joint)
        # What no model makes a number of, or all find impossible, teaches nothing about them.
        teaches = jnp.isfinite(total)
        after = jnp.where(teaches, joint - jnp.where(teaches, total, 0), state.log_probabilities)
        any_awake = reduce(jnp.logical_or, every_awake)
        status = jnp.where(any_awake, Status.USED, Status.REJECTED).astype(jnp.int32)
        shares = jnp.exp(normalised_weights(before))
        shown = _mixed_innovation(model, measurement, shares, is_awake, any_awake, infos)
        shown = shown._replace(log_likelihood=total, status=status)
        return ModesState(state.time, members, after), shown

    def estimate(params: Params, state: ModesState) -> Gaussian:
        shares = jnp.exp(state.log_probabilities)
        found = _estimates(estimators, params, state)
        return Gaussian(*mixed_moments(shares, jnp.ones(count, bool), *found, angle))

    recursion = Recursion("imm", start, move, measure, estimate, model=model)
    # Members keep what they do not use, and then nothing here is learnt.
    return estimator_from(recursion._replace(moves_back=True, keeps=True))


def _mixed_members(
    estimators: Sequence[Estimator],
    params: Params,
    state: ModesState,
    chances: Array,
    angle: Angles,
) -> ModesState:
    """The state after models have changed with `chances` (M, M), before its members move."""
    log_weights, shares = passed_on(state.log_probabilities, chances)
    means, covs = _estimates(estimators, params, state)
    every, members = jnp.ones(len(estimators), bool), []
    for j, (estimator, own) in enumerate(zip(estimators, state.members, strict=True)):
        moments = Gaussian(*mixed_moments(shares[:, j], every, means, covs, angle))
        # To a model that nothing goes to there are no moments; it stays as it is.
        is_reached = jnp.isfinite(log_weights[j])
        safe = choose(is_reached, moments, Gaussian(means[j], covs[j]))
        # As part of a program: moments made by mixing are no prior of a user's, to be looked at.
        enter = jax.jit(estimator.init, inline=True)
        members.append(choose(is_reached, enter(params, safe, state.time), own))
    return ModesState(state.time, tuple(members), log_weights)


def _mixed_innovation(
    model: Model | None,
    measurement: Measurement,
    shares: Array,
    is_awake: Array,
    any_awake: Array,
    infos: Sequence[Info],
) -> Info:
    """`Info` with the moments of the innovation of all models that predict one, with `shares` (M,)
    of those that do, `is_awake` (M,)."""
    sensor, mask = measurement.sensor, measurement.mask

    def apart(x: Array, y: Array) -> Array:
        return x - y if model is None else model.residual(x, y, sensor)

    # Angles on both sides of a cut have a mean, counted from the first of them.
    first = infos[0].innovation
    values = together(*(first + apart(info.innovation, first) for info in infos))
    covs = together(*(info.innovation_cov for info in infos))
    mean, cov = mixed_moments(shares, is_awake, values, covs)
    mean = apart(mean, jnp.zeros_like(mean))
    seen = mask & any_awake
    # Parameters that make no covariances say so by NaN, in whichever model.
    is_broken = ~jnp.all(jnp.isfinite(covs))
    cov = jnp.where(is_broken, jnp.nan, gaussian.mask_cov(cov, seen))
    return infos[0]._replace(innovation=jnp.where(seen, mean, 0), innovation_cov=cov)


def _estimates(
    estimators: Sequence[Estimator], params: Params, state: ModesState
) -> tuple[Array, Array]:
    """Means (M, n) and covariances (M, n, n) of the members."""
    pairs = zip(estimators, state.members, strict=True)
    found = [e.estimate(params, own) for e, own in pairs]
    return together(*(x.mean for x in found)), together(*(x.cov for x in found))


def imm_probabilities(state: ModesState) -> Array:
    """The probabilities (M,) of the models of an `imm`, (R, M) of a batch; they sum to 1.

    Args:
        state: of an `imm`, from `init`, `step`, or `Trace.final_state`; of a `replay` or `gated` of
            one, its `current`.
    """
    is_modes = isinstance(state, ModesState)
    checks.require(is_modes, "state", "a state of `imm`", type(state).__name__)
    return jnp.exp(state.log_probabilities)
