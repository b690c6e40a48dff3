"""What the ensemble filters for late measurements share: the ensembles of the last update times."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels.trees import choose, copies
from ewif_jax.models import Model
from ewif_jax.models.angles import wrapped_state
from ewif_jax.recursions import ensembles
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.ensembles import EnsembleState
from ewif_jax.recursions.innovations import info_of
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Params


class Slots(NamedTuple):
    """Newest first: time (L,), members (L, n, N) as the filter left them, and ahead (L, n, N):
    where they would be now with the noise since but no measurement, or None."""

    time: Array
    members: Array
    ahead: Array | None


class EnsembleHistory(NamedTuple):
    """The fields of `EnsembleState`; used (): whether this time has taken a measurement; past."""

    time: Array
    members: Array
    key: Array
    sight: Array
    used: Array
    past: Slots


class Bracket(NamedTuple):
    """The ensemble at a time by interpolation, and what its own forecast of now would be (None
    where forecasts are not kept)."""

    there: Array
    ahead: Array | None


Retrodict = Callable[[Any, EnsembleHistory, Bracket, Array, Array], Array]
"""(params, state, bracket, time, key) -> members (n, N) at `time`, a late measurement's."""


def delayed(
    model: Model, method: str, members: int, lag: int, retrodict: Retrodict, forecasts: bool
) -> Estimator:
    """An ensemble filter whose late update relates the members now to those `retrodict` gives.

    The ensemble of a time is stored when the filter leaves that time, with everything it had taken
    until then, and is never rewritten. Times without a used measurement are not stored. The prior
    at t0 is the first entry.
    """
    checks.require(isinstance(model, Model), "model", "a Model", type(model).__name__)
    count = checks.whole("members", members, 2)
    lag = checks.whole("lag", lag, 1)

    def start(params: Params, prior: Gaussian, t0: Array, key: Array) -> EnsembleHistory:
        del params
        first = ensembles.drawn(prior, t0, key, count)
        times, stored = copies((first.time, first.members), lag)
        past = Slots(times, stored, stored if forecasts else None)
        return EnsembleHistory(*first, jnp.asarray(False), past)

    def move(params: Params, state: EnsembleHistory, time: Array) -> EnsembleHistory:
        now, noise_met = ensembles.moved_members(model, params, present(state), time)
        past = state.past
        if past.ahead is not None:

            def carried(x: Array) -> Array:
                return ensembles.carried_members(model, params, x, state.time, time) + noise_met

            # The forecasts of all slots meet the noise that the members met, so that what differs
            # between them is the measurements alone.
            past = past._replace(ahead=jax.vmap(carried)(past.ahead))
        past = choose(state.used, _pushed_slots(past, state, now.members), past)
        left = EnsembleHistory(*now, jnp.asarray(False), past)
        return choose(time > state.time, left, state)

    def within_lag(params: Params, state: EnsembleHistory, time: Array) -> Array:
        del params
        return time >= state.past.time[-1]

    def measure(
        params: Params, state: EnsembleHistory, measurement: Measurement
    ) -> tuple[EnsembleHistory, Info]:
        own, sight = ensembles.sight_keys(state.sight, measurement.sensor)
        then = jnp.minimum(measurement.time, state.time)
        there = retrodict(
            params,
            state,
            _interpolated_at(model, state, then),
            then,
            ensembles.back_key(state.sight),
        )
        # Nothing was learned since "now", and a regression on rounding would move the members.
        there = jnp.where(then < state.time, there, state.members)
        looked = ensembles.look_of_ensemble(model, params, state.members, there, measurement)
        members = ensembles.perturbed(state.members, looked, own)
        info = info_of(looked.innovation, looked.mask, looked.all_finite)
        return state._replace(members=members, sight=sight, used=jnp.asarray(True)), info

    def estimate(params: Params, state: EnsembleHistory) -> Gaussian:
        del params
        return ensembles.sample_moments(state.members, model.state_angle)

    recursion = Recursion(method, start, move, measure, estimate, within_lag, model=model)
    return estimator_from(recursion._replace(draws=True, estimated=("members",)))


def present(state: EnsembleHistory) -> EnsembleState:
    """The ensemble now, without its past."""
    return EnsembleState(*state[:4])


def _pushed_slots(past: Slots, left: EnsembleHistory, now: Array) -> Slots:
    """The slots with the ensemble that was left in front; its forecast is what it became, `now`."""
    entry = Slots(left.time, left.members, None if past.ahead is None else now)
    return jax.tree.map(lambda new, old: jnp.concatenate([new[None], old[:-1]]), entry, past)


def _interpolated_at(model: Model, state: EnsembleHistory, time: Array) -> Bracket:
    """Eq. (26) between the newest entry not newer than `time` and the next one, which may be now;
    forecasts likewise."""
    past = state.past
    # Times fall along the slots, so their count is the index; the clamp only serves times that are
    # out of reach, which are masked.
    newer = jnp.minimum(jnp.sum(past.time > time), past.time.shape[0] - 1)
    after = jnp.maximum(newer - 1, 0)
    last = newer == 0
    start = past.time[newer]
    end = jnp.where(last, state.time, past.time[after])
    apart = end > start
    share = jnp.where(apart, (time - start) / jnp.where(apart, end - start, 1), 1)
    share = jnp.clip(share, 0, 1)

    def between(table: Array) -> Array:
        newest = jnp.where(last, state.members, table[after])
        # An angle goes the shorter way round.
        away = newest - table[newer]
        turns = away - wrapped_state(model.state_angle, away)
        return (1 - share) * table[newer] + share * (newest - turns)

    ahead = None if past.ahead is None else between(past.ahead)
    return Bracket(between(past.members), ahead)
