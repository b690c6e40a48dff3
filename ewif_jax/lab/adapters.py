"""Filters of FilterPy, pykalman and dynamax as ours.

Nothing of theirs is imported: each is read by its public attributes, so any object with these
attributes will do, and what lacks one is refused by the name of that attribute.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.estimators.fading import fading
from ewif_jax.estimators.kalman import kalman
from ewif_jax.models.inputs import Inputs, inputs
from ewif_jax.models.model import Model, linear_model
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Estimator, Gaussian, Numbers, Parameter, Params


class Adapted(NamedTuple):
    """A filter of another library, ready for `ej.run(estimator, None, stream, prior=, t0=)`.

    estimator: the same filter. model: its model in discrete time, without fading, for other filters
    (`asd(model, 8)`, ...). prior: mean and covariance at t0. t0: 0. dt: seconds of one step. first:
    time of the first measurement, one step after t0 where the library predicts first, t0 where it
    updates first.
    """

    estimator: Estimator
    model: Model
    prior: Gaussian
    t0: float
    dt: float
    first: float

    def times(self, count: int) -> np.ndarray:
        """(count,) when the library takes its measurements to be true, one each step."""
        return self.first + self.dt * np.arange(checks.whole("count", count, 0))


def from_filterpy(kf: Any, *, dt: float = 1.0, u: Parameter = None) -> Adapted:
    r"""FilterPy's `KalmanFilter` as it stands now, as an `Adapted`.

    Its loop is predict, update: the first measurement is one step after x and P. Read are x, P, F,
    H, Q, R, alpha, and with `u` also B: :math:`x \leftarrow F x + B u,\; P \leftarrow \alpha^2 F P
    F' + Q`. An alpha above 1 gives `fading`, else it is `kalman`. A measurement that is None there
    is a row of NaN, or one that is left out: the next one has a later time.

    Args:
        kf: the filter; or any object with these attributes (`FadingKalmanFilter`,
            `SquareRootKalmanFilter`).
        dt: seconds of one step, those of which its F and Q speak.
        u: the inputs given to `predict(u)`: (K, k), row k for the step from k dt to (k + 1) dt, the
            last row from then on; or `inputs(times, values)`, or a function of `params` that gives
            them. None: no input, as in `predict()`.

    Raises:
        ValueError: an attribute that is missing (the extended and unscented filters have no matrix
            H: give `models.sensor` their function of the state, and take `extended`), or is no
            constant matrix of the right shape; a cross correlation M (of `update_correlated`); u
            without B.

    Reduces to: the means, covariances and log likelihoods of FilterPy.
    """
    x = np.asarray(_attribute(kf, "kf", "x"), float)
    column = x.ndim == 2 and x.shape[1] == 1
    mean = _vector("kf.x", x[:, 0] if column else x, ("n",))
    n = len(mean)
    F = _matrix("kf.F", _attribute(kf, "kf", "F"), (n, n))
    H = _matrix("kf.H", _attribute(kf, "kf", "H"), ("m", n))
    Q, P = (_matrix(f"kf.{name}", _attribute(kf, "kf", name), (n, n)) for name in "QP")
    R = _matrix("kf.R", _attribute(kf, "kf", "R"), (len(H), len(H)))
    alpha = float(getattr(kf, "alpha", 1.0))
    checks.at_least("kf.alpha", alpha, 1.0)
    crossed = getattr(kf, "M", None)
    checks.require(crossed is None or not np.any(crossed), "kf.M", "no cross correlation", crossed)
    B = None if u is None else _matrix("kf.B", _attribute(kf, "kf", "B"), (n, "k"))
    driven = {"B": B, "u": _steps_of_input(u, dt, 0), "dt": dt}
    model = linear_model(F, H, R, Q, **driven)
    estimator = kalman(model)
    if alpha > 1:
        # There each step inflates the noise of those before it too; over the steps of a gap that is
        # the noise gathered by alpha F.
        gathered = linear_model(alpha * F, H, R, Q, dt=dt).process_cov
        estimator = fading(linear_model(F, H, R, gathered, **driven), alpha)
    return Adapted(estimator, model, _prior(mean, P), 0.0, float(dt), float(dt))


def from_dynamax(params: Any, *, dt: float = 1.0, u: Parameter = None) -> Adapted:
    r"""dynamax's `ParamsLGSSM` as an `Adapted`: what `lgssm_filter` computes.

    Its loop is update, predict: the first measurement is at the time of the initial state. Read are
    `initial` (mean, cov), `dynamics` (weights, bias, cov, input_weights) and `emissions` (weights,
    bias, cov, input_weights): :math:`x \leftarrow F x + B u + b + w,\; z = H x + d + v`.

    Args:
        params: with constant matrices; the covariance of emissions may be a vector of variances.
        dt: seconds of one step.
        u: its `inputs`: (K, k), row k for the step that ends at k dt, as in dynamax 1.0.3, the last
            row from then on; or `inputs(times, values)`, or a function of `params` that gives them.
            None: zero.

    Raises:
        ValueError: an attribute that is missing, or is no constant of the right shape (weights
            that vary in time, or are functions); u where its effect on the emissions is not 0
            (subtract it from the values); u without input weights.

    Reduces to: the means, covariances and log likelihood of `lgssm_filter`.

    Deviations: `lgssm_filter` adds 1e-9 to the diagonal of S before it solves for the gain.
    """
    initial, dynamics, emissions = (
        _attribute(params, "params", name) for name in ("initial", "dynamics", "emissions")
    )
    mean = _vector("initial.mean", _attribute(initial, "initial", "mean"), ("n",))
    n = len(mean)
    P = _matrix("initial.cov", _attribute(initial, "initial", "cov"), (n, n))
    F = _matrix("dynamics.weights", _attribute(dynamics, "dynamics", "weights"), (n, n))
    Q = _matrix("dynamics.cov", _attribute(dynamics, "dynamics", "cov"), (n, n))
    b = _vector("dynamics.bias", _or_zeros(_attribute(dynamics, "dynamics", "bias"), n), (n,))
    H = _matrix("emissions.weights", _attribute(emissions, "emissions", "weights"), ("m", n))
    m = len(H)
    R = _attribute(emissions, "emissions", "cov")
    R = np.diag(_vector("emissions.cov", R, (m,))) if np.ndim(R) == 1 else R
    R = _matrix("emissions.cov", R, (m, m))
    d = _vector("emissions.bias", _or_zeros(_attribute(emissions, "emissions", "bias"), m), (m,))
    B = None
    if u is not None:
        driving = _attribute(dynamics, "dynamics", "input_weights")
        B = _matrix("dynamics.input_weights", driving, (n, "k"))
        seen = _attribute(emissions, "emissions", "input_weights")
        none = seen is None or not np.any(seen)
        checks.require(none, "emissions.input_weights", "zeros where there is an input", seen)
    driven = _steps_of_input(u, dt, -1)
    model = _shifted(linear_model(F, H, R, Q, b, B=B, u=driven, dt=dt), d)
    return Adapted(kalman(model), model, _prior(mean, P), 0.0, float(dt), 0.0)


def from_pykalman(kf: Any, *, dt: float = 1.0) -> Adapted:
    """pykalman's `KalmanFilter` as an `Adapted`: what its `filter` and `loglikelihood` compute.

    Its loop is update, predict: the first measurement is at the time of the initial state. What is
    None is what pykalman takes for it: identity matrices, and zeros for means and offsets. A value
    that is masked there is NaN.

    Args:
        kf: with constant matrices and offsets.
        dt: seconds of one step.

    Raises:
        ValueError: an attribute that is missing, or is no constant of the right shape (lists of
            matrices that vary in time).

    Reduces to: the means, covariances and log likelihood of pykalman.
    """
    n, m = (int(_attribute(kf, "kf", name)) for name in ("n_dim_state", "n_dim_obs"))

    def matrix(name: str, shape: tuple[int, int]) -> np.ndarray:
        given = _attribute(kf, "kf", name)
        return _matrix(f"kf.{name}", np.eye(*shape) if given is None else given, shape)

    def vector(name: str, size: int) -> np.ndarray:
        return _vector(f"kf.{name}", _or_zeros(_attribute(kf, "kf", name), size), (size,))

    F, H = matrix("transition_matrices", (n, n)), matrix("observation_matrices", (m, n))
    Q, R = matrix("transition_covariance", (n, n)), matrix("observation_covariance", (m, m))
    model = linear_model(F, H, R, Q, vector("transition_offsets", n), dt=dt)
    model = _shifted(model, vector("observation_offsets", m))
    prior = _prior(vector("initial_state_mean", n), matrix("initial_state_covariance", (n, n)))
    return Adapted(kalman(model), model, prior, 0.0, float(dt), 0.0)


@from_recipe
def _shifted(model: Model, offset: Numbers) -> Model:
    """The linear model with z = H x + offset + v, offset (m,) a constant."""
    assert model.linear is not None

    def observe(params: Params, x: Array, sensor: Array, t: Array) -> Array:
        return model.observe(params, x, sensor, t) + jnp.asarray(offset, x.dtype)

    def shift(params: Params, sensor: Array, t: Array) -> Array:
        return jnp.asarray(offset)

    return model._replace(observe=observe, linear=model.linear._replace(offset=shift))


def _attribute(thing: Any, argument: str, name: str) -> Any:
    """What is called `name` there; refuses what has nothing of that name."""
    kind = type(thing).__name__
    got = f"one without it, of type {kind}"
    checks.require(hasattr(thing, name), argument, f"an object with the attribute {name!r}", got)
    return getattr(thing, name)


def _matrix(argument: str, value: Any, shape: tuple[int | str, ...]) -> np.ndarray:
    """A constant matrix; one number is (1, 1)."""
    checks.require(not callable(value), argument, "a constant matrix", "a function")
    checks.require(value is not None, argument, f"a matrix of shape {shape}", None)
    found = checks.from_rows(argument, value)
    given_sizes = {size for size in shape if isinstance(size, int)}
    found = found.reshape(1, 1) if found.ndim == 0 and given_sizes == {1} else found
    varies = "(what varies in time is a function of (params, t0, t1) in linear_model)"
    constant = f"a constant matrix {varies}"
    checks.require(found.ndim != 3, argument, constant, f"shape {found.shape}")
    checks.shape(argument, found, shape)
    checks.finite(argument, found)
    return np.array(found, float)


def _vector(argument: str, value: Any, shape: tuple[int | str, ...]) -> np.ndarray:
    """A constant vector."""
    checks.require(not callable(value), argument, "a constant vector", "a function")
    found = checks.from_rows(argument, value)
    checks.shape(argument, found, shape)
    checks.finite(argument, found)
    return np.array(found, float)


def _prior(mean: Any, cov: Any) -> Gaussian:
    """A Gaussian of NumPy's arrays, which keep their digits whatever the settings of JAX are."""
    return Gaussian(mean, cov)


def _or_zeros(value: Any, size: int) -> Any:
    return np.zeros(size) if value is None else value


def _steps_of_input(u: Parameter, dt: float, first: int) -> Parameter:
    """The input as `Inputs`, row 0 from step `first` on, or the function of `params` that gives
    them."""
    if u is None or callable(u) or isinstance(u, Inputs):
        return u
    rows = checks.from_rows("u", u)
    return inputs(dt * (first + np.arange(len(rows))), rows)
