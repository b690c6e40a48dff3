"""What every filter has in common: this file turns the plain maths of one into an `Estimator`.

The author of a filter writes four functions that know nothing of late data, masks or statuses
(`Recursion`); `estimator_from` adds what the contract of the package asks for. Nothing else in the
package decides a `Status` or what `Info` says of a measurement that was not used.
"""

from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels.trees import choose
from ewif_jax.models import Model
from ewif_jax.types import (
    Estimator,
    Gaussian,
    Info,
    Measurement,
    Numbers,
    Params,
    RandomKey,
    State,
    Status,
)


class Start(Protocol):
    """The state at t0. `prior` is a checked `Gaussian` of arrays in one dtype (None only if the
    recursion `starts_from_nothing`), t0 () has that dtype."""

    def __call__(self, params: Params, prior: Any, t0: Array, key: RandomKey, /) -> Any: ...


class Move(Protocol):
    """The state at `time`, which is not before the state's (unless the recursion `moves_back`)."""

    def __call__(self, params: Params, state: State, time: Array, /) -> Any: ...


class Measure(Protocol):
    """The state after a measurement, and its `Info`, of which delay and status are left to the
    contract (status: USED, or REJECTED if the filter refuses it).

    The measurement is within reach. Where its mask is False nothing was seen: with no component
    present the innovation is 0, its covariance the identity, and the log likelihood 0.
    """

    def __call__(
        self, params: Params, state: State, measurement: Measurement, /
    ) -> tuple[Any, Info]: ...


class Report(Protocol):
    """What is estimated of the state at its time."""

    def __call__(self, params: Params, state: State, /) -> Gaussian: ...


class Reach(Protocol):
    """Whether a measurement of this `time`, before the state's, can still be used, () bool."""

    def __call__(self, params: Params, state: State, time: Array, /) -> Array: ...


class Recursion(NamedTuple):
    """A filter in plain maths, and what it promises of itself.

    name: what errors call it.
    init, move, measure, estimate: see their protocols.
    reach: how far back it uses late measurements; None: not at all.
    moves_back: `move` takes times before the state's too. Otherwise they are predicted as NaN in
        the fields `estimated` of the state.
    model: of which the filter is one; its times are checked with it.
    starts_from_nothing: `init` accepts prior=None.
    inverts_prior: its covariance has to be positive definite.
    draws: `init` needs a key.
    keeps: a measurement of which nothing is present leaves the state as it is, to the last bit. A
        batch then pays nothing for measurements that are not used; otherwise the contract selects
        the old state for them, which costs a pass over it.
    remembers: a measurement that it rejects changes its state, as that of a gate which counts
        refusals.
    """

    name: str
    init: Start
    move: Move
    measure: Measure
    estimate: Report
    reach: Reach | None = None
    moves_back: bool = False
    starts_from_nothing: bool = False
    inverts_prior: bool = False
    draws: bool = False
    keeps: bool = False
    estimated: tuple[str, ...] = ("mean", "cov")
    model: Model | None = None
    remembers: bool = False


def estimator_from(recursion: Recursion) -> Estimator:
    """The estimator of a recursion."""
    name, start, move, measure, estimate = recursion[:5]

    def init(params: Params, prior: Gaussian | None, t0: Numbers, key: RandomKey = None) -> Any:
        if not recursion.starts_from_nothing:
            checks.needs_prior(prior, name)
        checks.prior(prior)
        if recursion.draws:
            checks.needs_key(key, name)
        if recursion.inverts_prior and prior is not None:
            checks.psd("prior.cov", prior.cov, definite=True)
        if prior is None:
            return start(params, None, _floating_time(t0), key)
        mean = jnp.asarray(prior.mean)
        given = Gaussian(mean, jnp.asarray(prior.cov, mean.dtype))
        return start(params, given, jnp.asarray(t0, mean.dtype), key)

    def predict(params: Params, state: State, time: Array) -> Any:
        time = jnp.asarray(time, state.time.dtype)
        if recursion.moves_back:
            return move(params, state, time)
        # Moved by no time where the time is earlier: NaN made by the motion back would reach the
        # gradient through the `where` below (inf or NaN times 0).
        moved = move(params, state, jnp.maximum(time, state.time))
        forwards = time >= state.time
        fields = {x: jnp.where(forwards, getattr(moved, x), jnp.nan) for x in recursion.estimated}
        return moved._replace(time=time, **fields)

    def take(params: Params, state: State, measurement: Measurement) -> tuple[Any, Info]:
        """A measurement within reach, or one of which nothing is present."""
        updated, info = measure(params, state, measurement)
        present, late = jnp.any(measurement.mask), measurement.time < state.time
        accepted = changed = info.status != Status.REJECTED
        likelihood = jnp.where(accepted, info.log_likelihood, 0)
        # Parameters outside of their domain make NaN of Q or R, and so of all that follows. What
        # starts from nothing also says by NaN that nothing is known; it refuses the former.
        is_broken = ~jnp.all(jnp.isfinite(info.innovation_cov))
        if recursion.starts_from_nothing:
            is_broken &= ~accepted
        likelihood = jnp.where(is_broken, -jnp.inf, likelihood)
        accepted, changed = accepted & ~is_broken, accepted | is_broken | recursion.remembers
        used = jnp.where(late, Status.LATE_USED, Status.USED)
        status = jnp.where(accepted, used, Status.REJECTED)
        status = jnp.where(present, status, Status.MASKED).astype(jnp.int32)
        info = info._replace(log_likelihood=jnp.where(present, likelihood, 0), status=status)
        return (updated if recursion.keeps else choose(present & changed, updated, state)), info

    def update(params: Params, state: State, measurement: Measurement) -> tuple[Any, Info]:
        in_sequence = measurement.time >= state.time
        within_reach = in_sequence
        if recursion.reach is not None:
            within_reach |= recursion.reach(params, state, measurement.time)
        return offered(take, params, state, measurement, within_reach)

    return Estimator(init, predict, update, estimate, model=recursion.model)


def offered(
    take: Measure, params: Params, state: State, measurement: Measurement, within_reach: Array
) -> tuple[Any, Info]:
    """`take` of a measurement that is not shown to it unless `within_reach`: `TOO_LATE` then.

    It is masked, not undone afterwards: a filter that sees nothing does nothing, so a batch has no
    old state to keep and select.
    """
    shown = measurement._replace(
        # The time too: an update at a time out of reach may be no number at all, though it is
        # masked.
        time=jnp.where(within_reach, measurement.time, state.time),
        mask=measurement.mask & within_reach,
    )
    updated, info = take(params, state, shown)
    too_late = jnp.any(measurement.mask) & ~within_reach
    status = jnp.where(too_late, jnp.int32(Status.TOO_LATE), info.status)
    return updated, info._replace(delay=state.time - measurement.time, status=status)


def let_through(inside: Array, state: State, updated: State, info: Info) -> tuple[Any, Info]:
    """The update of `state`, unless a gate says that it is not `inside`: then the state as it was,
    `REJECTED`, with the innovation and covariance that the gate judged."""
    likelihood = jnp.where(inside, info.log_likelihood, 0)
    status = jnp.where(inside, info.status, jnp.int32(Status.REJECTED))
    info = info._replace(log_likelihood=likelihood, status=status)
    return choose(inside, updated, state), info


def is_used(info: Info) -> Array:
    """Whether a measurement has been used, late or not, () bool."""
    return (info.status == Status.USED) | (info.status == Status.LATE_USED)


def _floating_time(t0: Numbers) -> Array:
    t0 = jnp.asarray(t0)
    return t0 if jnp.issubdtype(t0.dtype, jnp.floating) else t0.astype(float)
