"""The types every part of the package speaks: all are pytrees, and their field names are fixed."""

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

from jax import Array

from ewif_jax import shown
from ewif_jax.recipe import FromRecipe

Params = Any
"""What parameters are read from: any pytree; gradients are taken with respect to it."""
State = Any
"""A filter's state: a pytree with a field `time`, of a kind that only the filter knows."""
PyTree = Any
"""Any pytree."""
Parameter = Any
"""A parameter of a builder: a number, an array, or a function of `params` (and of times)."""
Numbers = Any
"""What becomes an array: of NumPy or JAX, a number, a list; traced or not."""
RandomKey = Any
"""A PRNG key of JAX, or None where nothing is drawn."""
DTypeLike = Any
"""A dtype, or what names one."""


class Measurement(NamedTuple):
    """One arrival. Stacked on axis 0 it is a stream, in the order of arrival.

    time: () validity time in seconds (when the value was true, not when it arrived).
    value: (m,) the measured numbers, in the units of the model's `observe`.
    sensor: () int32, which sensor of the model.
    mask: (m,) bool, which components exist; all False means that nothing arrived (padding).
    """

    time: Array
    value: Array
    sensor: Array
    mask: Array

    def __repr__(self) -> str:
        lines = shown.stream_lines("Measurement", *self)
        return tuple.__repr__(self) if lines is None else shown.as_text(lines)

    def _repr_html_(self) -> str | None:
        lines = shown.stream_lines("Measurement", *self)
        return None if lines is None else shown.as_html(lines)


class Gaussian(NamedTuple):
    """mean (n,) and cov (n, n)."""

    mean: Array
    cov: Array


class Status(IntEnum):
    """What became of a measurement."""

    USED = 0
    """in sequence, used"""
    LATE_USED = 1
    """older than the state, used"""
    TOO_LATE = 2
    """older than the method can use: the estimate is unchanged"""
    REJECTED = 3
    """refused by a gate, or because its innovation (in its present components) or log likelihood is
    not finite: the estimate is unchanged, and what is not finite in its innovation is reported as 0
    """
    MASKED = 4
    """no component present: unchanged"""


class Info(NamedTuple):
    """Diagnostics of one update.

    innovation: (m,) measured minus predicted; 0 in absent components.
    innovation_cov: (m, m) its covariance before the update; identity rows for absent components.
    log_likelihood: () log density of this measurement given the earlier ones; 0 if it was not used.
    delay: () state time minus measurement time in seconds, positive when late.
    status: () int32, a `Status`.
    """

    innovation: Array
    innovation_cov: Array
    log_likelihood: Array
    delay: Array
    status: Array


class Steps(NamedTuple):
    """How the time of a discrete-time model is counted: in whole steps of `dt` seconds, at most
    `max_steps` of them at once."""

    dt: float
    max_steps: int


class Init(Protocol):
    """The first state: of the prior at time t0; the PRNG key is for a filter that draws noise.

    Everything is in the dtype of `t0`. `prior` is None where nothing is known about the state.
    """

    def __call__(
        self, params: Params, prior: Gaussian | None, t0: Array, /, key: RandomKey = None
    ) -> Any: ...


class Predict(Protocol):
    """The state moved to `time` (), with what the filter knows. Earlier than the state: NaN in what
    `estimate` reports of it, unless the method can go back."""

    def __call__(self, params: Params, state: State, time: Array, /) -> Any: ...


class Update(Protocol):
    """The state after a measurement at its time or an earlier one, and diagnostics."""

    def __call__(
        self, params: Params, state: State, measurement: Measurement, /
    ) -> tuple[Any, Info]: ...


class Estimate(Protocol):
    """The mean (n,) and covariance (n, n) that a state stands for."""

    def __call__(self, params: Params, state: State, /) -> Gaussian: ...


class _Estimator(NamedTuple):
    init: Init
    predict: Predict
    update: Update
    estimate: Estimate
    series: Callable[..., Any] | None = None
    model: Any = None


class Estimator(FromRecipe, _Estimator):
    """Four pure functions; every filter of the package, in sequence or not, is one.

    init(params, prior, t0, key=None) -> state
    predict(params, state, time) -> state at `time`
    update(params, state, measurement) -> (state, Info); accepts measurement.time <= state.time
    estimate(params, state) -> Gaussian
    series: how a whole series is filtered faster with the same result, if there is a way

    model: what the filter is a filter of, if one Model says it: a model in discrete time has no
        state between two of its steps

    A state is a pytree with a field `time` and holds only what the next step needs. A wrapper that
    changes one of the four builds a new `Estimator`, and so leaves `series` behind.
    """


class Trace(NamedTuple):
    """What `run` returns, stacked over arrivals: time (T,), mean (T, n), cov (T, n, n), info, the
    state after the last arrival (ready for `step`), and what was recorded besides, if anything."""

    time: Array
    mean: Array
    cov: Array
    info: Info
    final_state: Any
    recorded: Any = None

    def __repr__(self) -> str:
        lines = self._lines()
        return tuple.__repr__(self) if lines is None else shown.as_text(lines)

    def _repr_html_(self) -> str | None:
        lines = self._lines()
        return None if lines is None else shown.as_html(lines)

    def _lines(self) -> dict[str, str] | None:
        status = getattr(self.info, "status", None)
        return shown.trace_lines(self.time, self.mean, self.cov, status, Status)
