"""A bank of exponentially weighted information filters: a decay time that adapts by itself."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels import gaussian
from ewif_jax.kernels.growth import decayed, exponential
from ewif_jax.models.entry import without_process_noise
from ewif_jax.models.linearise import need_linear, need_reversible
from ewif_jax.models.model import Model, resolve
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import information as form
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.information import InformationState
from ewif_jax.recursions.invertible import refuse_exact, refuse_one_way
from ewif_jax.recursions.mixtures import log_sum, mixed_moments, normalised_weights
from ewif_jax.types import (
    DTypeLike,
    Estimator,
    Gaussian,
    Info,
    Measurement,
    Parameter,
    Params,
    RandomKey,
    State,
    Status,
)


class BankState(NamedTuple):
    """time (), members: what each of K filters knows (leaves with a leading axis K; their times are
    all `time`), log_weights (K,)."""

    time: Array
    members: InformationState
    log_weights: Array


@from_recipe
def ewif_bank(model: Model, taus: Parameter, forgetting: Parameter = 0.98) -> Estimator:
    r"""K filters `ewif` of different decay times, mixed by how well each has predicted.

    .. math::
        w_k &\propto \big( \phi\, w_k^- + (1 - \phi) / K \big), \quad
            w_k^+ \propto w_k\, p_k(z), \quad
            \log p(z) = \log \sum_k w_k\, p_k(z) \\
        \hat x &= \sum_k w_k \hat x_k, \quad
            P = \sum_k w_k \big( P_k + (\hat x_k - \hat x)(\hat x_k - \hat x)' \big)

    with :math:`p_k` the predictive density of member k and :math:`\phi` = `forgetting`. Late
    measurements are used like any other: an EWIF needs no order.

    **Regret.** Over N measurements that all members predict, the log likelihood of the bank is at
    most :math:`\log K + (N - 1) \log(1/\phi)` below that of the best member, and at most
    :math:`(s + 1) \log K + s \log(1/(1 - \phi)) + (N - 1 - s) \log(1/\phi)` below that of the best
    sequence of members with s switches (fixed share; Herbster & Warmuth 1998).

    Args:
        model: a linear `Model`, as for `ewif`.
        taus: (K,) decay times in seconds, > 0, numbers or a function of `params`.
        forgetting: the weight that a measurement leaves where it was; 1 - forgetting of it is
            shared out equally before each measurement, so that a member that was bad for long comes
            back soon. In (0, 1]; 1: none. A number or a function of `params`.

    A member that does not know the state yet, or any more, predicts nothing: its weight waits, and
    the others are mixed in its place. The estimate is NaN while none knows it.

    Reduces to: `ewif` for one decay time (or equal ones).

    Deviations: the covariance has the spread of the means, so it answers to disagreement; it is
        still built of the covariances of `ewif`, which are not those of the error.

    Raises:
        ValueError: taus that are not positive; forgetting outside of (0, 1]; what `ewif` refuses.
    """
    need_linear(model, "ewif_bank")
    need_reversible(model, "ewif_bank")
    if not callable(taus):
        _check_taus(taus)
    if not callable(forgetting):
        _check_share(forgetting)

    def decays(params: Params, dtype: DTypeLike) -> Array:
        return jnp.asarray(_check_taus(resolve(taus, params)), dtype)

    def start(params: Params, prior: Gaussian | None, t0: Array, key: RandomKey) -> BankState:
        del key
        _check_share(resolve(forgetting, params))
        refuse_exact(model, params, t0, "ewif_bank")
        refuse_one_way(model, params, "ewif_bank")
        first = form.start(model, params, prior, t0)
        count = decays(params, first.mean.dtype).shape[0]
        members = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), first)
        weights = jnp.full(count, -jnp.log(jnp.asarray(count, first.mean.dtype)))
        return BankState(first.time, members, weights)

    def move(params: Params, state: BankState, time: Array) -> BankState:
        def moved(member: InformationState, tau: Array) -> InformationState:
            def fade(variances: Array) -> Array:
                return decayed(variances, time - state.time, tau)

            return form.transport(model, params, member, time, fade)

        members = jax.vmap(moved)(state.members, decays(params, time.dtype))
        return BankState(time, members, state.log_weights)

    def measure(
        params: Params, state: BankState, measurement: Measurement
    ) -> tuple[BankState, Info]:
        def measured(member: InformationState, tau: Array) -> tuple[InformationState, Info]:
            growth = exponential(state.time - measurement.time, tau)
            return form.absorb(model, params, member, measurement, growth)

        members, infos = jax.vmap(measured)(state.members, decays(params, state.time.dtype))
        is_awake = jax.vmap(form.determined)(state.members)
        share = jnp.asarray(resolve(forgetting, params), state.log_weights.dtype)
        # Before the measurement, so that the mixture which predicts it is the one that the regret
        # bound is about (docs/decisions/estimators.md: "A bank forgets by sharing, not by
        # flattening").
        shared = _shared_weights(state.log_weights, share)
        within = normalised_weights(jnp.where(is_awake, shared, -jnp.inf))
        told = jnp.where(is_awake, infos.log_likelihood, 0)
        total = log_sum(jnp.where(is_awake, within + told, -jnp.inf))
        # What nobody can predict, or all find impossible, teaches nothing about the members.
        teaches = jnp.any(is_awake) & jnp.isfinite(total)
        learnt = jnp.where(is_awake, shared + told - jnp.where(teaches, total, 0), shared)
        weights = normalised_weights(jnp.where(teaches, learnt, state.log_weights))
        info = _mixed_info(infos, jnp.exp(within), is_awake, total, measurement.mask)
        return BankState(state.time, members, weights), info

    def estimate(params: Params, state: BankState) -> Gaussian:
        del params
        means, covs = jax.vmap(form.estimate)(state.members)
        is_awake = jax.vmap(form.determined)(state.members)
        weights = jnp.exp(normalised_weights(jnp.where(is_awake, state.log_weights, -jnp.inf)))
        mean, cov = mixed_moments(weights, is_awake, means, covs)
        any_awake = jnp.any(is_awake)
        return Gaussian(jnp.where(any_awake, mean, jnp.nan), jnp.where(any_awake, cov, jnp.nan))

    def any_time(params: Params, state: State, time: Array) -> Array:
        del params, state
        return jnp.isfinite(time)

    recursion = Recursion("ewif_bank", start, move, measure, estimate, any_time)
    recursion = recursion._replace(moves_back=True, starts_from_nothing=True, inverts_prior=True)
    return estimator_from(recursion._replace(model=without_process_noise(model)))


def bank_weights(state: BankState) -> Array:
    """The weights (K,) of the members of an `ewif_bank`, (R, K) of a batch; they sum to 1.

    Args:
        state: of an `ewif_bank`, from `init`, `step`, or `Trace.final_state`.
    """
    is_bank = isinstance(state, BankState)
    checks.require(is_bank, "state", "a state of `ewif_bank`", type(state).__name__)
    return jnp.exp(state.log_weights)


def _check_taus(taus: Parameter) -> Any:
    checks.shape("taus", taus, ("K",))
    checks.require(np.shape(taus)[0] > 0, "taus", "at least one decay time", "none")
    checks.positive("taus", taus)
    return taus


def _check_share(forgetting: Parameter) -> None:
    checks.shape("forgetting", forgetting, ())
    value = checks.concrete_value(forgetting)
    if value is not None:
        inside = bool((value > 0) & (value <= 1))
        checks.require(inside, "forgetting", "a number in (0, 1]", forgetting)


def _shared_weights(log_weights: Array, forgetting: Array) -> Array:
    """The weights after each has given the share 1 - forgetting away, equally to all."""
    shares = forgetting < 1
    kept = jnp.where(shares, forgetting, 0.5)
    mixed = jnp.log(kept * jnp.exp(log_weights) + (1 - kept) / log_weights.shape[0])
    # Without sharing a weight may be smaller than any number that is not a logarithm.
    return jnp.where(shares | jnp.isnan(forgetting), mixed, log_weights)


def _mixed_info(infos: Info, weights: Array, is_awake: Array, total: Array, mask: Array) -> Info:
    """The mixture's `Info`: NaN innovation and log likelihood 0 while no member predicts."""
    innovation, cov = mixed_moments(weights, is_awake, infos.innovation, infos.innovation_cov)
    any_awake = jnp.any(is_awake)
    is_used = any_awake & jnp.any(infos.status == Status.USED)
    # Of what is absent, exactly 0 and the identity: weights sum to 1 up to rounding only.
    innovation = jnp.where(any_awake, jnp.where(mask, innovation, 0), infos.innovation[0])
    cov = jnp.where(any_awake, gaussian.mask_cov(cov, mask), infos.innovation_cov[0])
    likelihood = jnp.where(is_used, total, 0)
    return Info(innovation, cov, likelihood, infos.delay[0], infos.status[0])
