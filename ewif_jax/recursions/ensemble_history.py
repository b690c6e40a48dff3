"""What the ensemble filters for late measurements share: the ensembles of the last update times."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels.trees import choose, copies
from ewif_jax.models import Model
from ewif_jax.recursions import ensembles
from ewif_jax.recursions.contract import verdict
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status


class Slots(NamedTuple):
    """Newest first: time (L,), members (L, n, N) as the filter left them, and ahead (L, n, N):
    where they would be now with the noise since but no measurement, or None."""

    time: Array
    members: Array
    ahead: Array | None


class EnsembleHistory(NamedTuple):
    """now: time, members and keys; used (): whether this time has taken a measurement; past."""

    time: Array
    now: ensembles.EnsembleState
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

    def init(params: Any, prior: Gaussian | None, t0: Any, key: Any = None) -> EnsembleHistory:
        del params
        now = ensembles.start(prior, t0, key, count, method)
        times, stored = copies((now.time, now.members), lag)
        past = Slots(times, stored, stored if forecasts else None)
        return EnsembleHistory(now.time, now, jnp.asarray(False), past)

    def predict(params: Any, state: EnsembleHistory, time: Array) -> EnsembleHistory:
        time = jnp.asarray(time, state.time.dtype)
        ahead = jnp.maximum(time, state.time)
        now, met = ensembles.moved(model, params, state.now, ahead)
        past = state.past
        if past.ahead is not None:

            def carried(x: Array) -> Array:
                return ensembles.carried(model, params, x, state.time, ahead) + met

            past = past._replace(ahead=jax.vmap(carried)(past.ahead))
        past = choose(state.used, _pushed(past, state.now, now), past)
        left = EnsembleHistory(ahead, now, jnp.asarray(False), past)
        moved = choose(ahead > state.time, left, state)
        shown = jnp.where(time >= state.time, moved.now.members, jnp.nan)
        return moved._replace(time=time, now=moved.now._replace(time=time, members=shown))

    def update(
        params: Any, state: EnsembleHistory, measurement: Measurement
    ) -> tuple[EnsembleHistory, Info]:
        time, now = measurement.time, state.now
        late, present = time < state.time, jnp.any(measurement.mask)
        newer = jnp.sum(state.past.time > time)
        within_lag = newer < lag
        reached = measurement._replace(mask=measurement.mask & within_lag)
        own, sight = ensembles.sight_keys(now.sight, measurement.sensor)
        motion = ensembles.back_key(now.sight)
        bracket = _interpolated(state, jnp.minimum(newer, lag - 1), time)
        there = retrodict(params, state, bracket, jnp.minimum(time, state.time), motion)
        there = jnp.where(late, there, now.members)
        looked = ensembles.look(model, params, now.members, there, reached)
        updated = ensembles.perturbed(now.members, looked, own)
        used = within_lag & present & looked.good
        late_status = jnp.where(within_lag, Status.LATE_USED, Status.TOO_LATE)
        status = verdict(late, present, late_status, looked.good)
        info = ensembles.info_of(looked, state.time - time, used, status)
        taken = state._replace(
            now=now._replace(members=updated, sight=sight), used=jnp.asarray(True)
        )
        return choose(used, taken, state), info

    def estimate(params: Any, state: EnsembleHistory) -> Gaussian:
        del params
        return ensembles.moments(state.now.members)

    return Estimator(init, predict, update, estimate, model=model)


def _pushed(past: Slots, left: ensembles.EnsembleState, now: ensembles.EnsembleState) -> Slots:
    """The slots with the ensemble that was left in front; its forecast is the one that moved."""
    entry = Slots(left.time, left.members, None if past.ahead is None else now.members)
    return jax.tree.map(lambda new, old: jnp.concatenate([new[None], old[:-1]]), entry, past)


def _interpolated(state: EnsembleHistory, newer: Array, time: Array) -> Bracket:
    """Eq. (26) between the newest entry not newer than `time` and the next one, which may be now;
    forecasts likewise."""
    past, now = state.past, state.now
    after = jnp.maximum(newer - 1, 0)
    last = newer == 0
    start = past.time[newer]
    end = jnp.where(last, state.time, past.time[after])
    apart = end > start
    share = jnp.where(apart, (time - start) / jnp.where(apart, end - start, 1), 1)
    share = jnp.clip(share, 0, 1)

    def between(table: Array) -> Array:
        newest = jnp.where(last, now.members, table[after])
        return (1 - share) * table[newer] + share * newest

    ahead = None if past.ahead is None else between(past.ahead)
    return Bracket(between(past.members), ahead)
