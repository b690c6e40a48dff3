"""What is refused before anything is traced.

Every function looks only at values that are known now (not at tracers), and every error names the
argument, what was expected and what came.
"""

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from ewif_jax.types import Estimator, Gaussian, Measurement, Numbers, RandomKey

SMALL = 800
"""Bytes of matrices whose eigenvalues are kept: working them out again takes as long as filtering
a short stream."""


def concrete_value(x: Numbers) -> np.ndarray | None:
    """`x` as a NumPy array if its value is known now, else None."""
    return None if isinstance(x, Tracer) else np.asarray(x)


def with_dtype(x: Numbers, argument: str = "measurements") -> Any:
    """`x` if it is an array, else (numbers, lists, columns of tables) as a NumPy array."""
    arrays = Array | np.ndarray | np.generic | jax.ShapeDtypeStruct
    return x if isinstance(x, arrays) else from_rows(argument, x)


def from_rows(argument: str, x: Numbers) -> np.ndarray:
    """`x` (numbers, lists, columns of tables) as a NumPy array; refuses rows of unequal lengths."""
    try:
        return np.asarray(x)
    except ValueError as error:  # all that NumPy says is that it set an element with a sequence
        raise ValueError(f"{argument}: expected rows of equal lengths, got {error}") from error


def require(condition: object, argument: str, expected: str, got: object) -> None:
    """Raises a ValueError naming `argument` unless `condition` holds."""
    if not condition:
        raise ValueError(f"{argument}: expected {expected}, got {got}")


class Shown:
    """What `repr` says of a thing, worked out only if it is printed."""

    def __init__(self, thing: Any):
        self.thing = thing

    def __str__(self) -> str:
        return repr(self.thing)


def shape(argument: str, x: Numbers, expected: tuple[int | str, ...]) -> None:
    """Refuses an array whose shape differs; a string in `expected` stands for any length."""
    got = np.shape(x)
    same = len(got) == len(expected) and all(
        isinstance(e, str) or g == e for g, e in zip(got, expected, strict=True)
    )
    if not same:
        wanted = "(" + ", ".join(map(str, expected)) + ("," if len(expected) == 1 else "") + ")"
        require(False, argument, f"shape {wanted}", f"shape {got}")


def finite(argument: str, x: Numbers, mask: Numbers = True, where: str = "") -> None:
    """Refuses a known array with NaN or infinity in it (where a known mask holds, and `where` says
    so)."""
    if isinstance(x, Tracer):
        return
    value = np.asarray(x)
    got = value.dtype if value.ndim else Shown(x)
    require(_is_numeric(value), argument, "finite numbers", got)
    asked = None if squares_are_finite(x) else concrete_value(mask)
    if asked is not None:
        bad = ~np.isfinite(value) & asked
        require(not bad.any(), argument, f"finite numbers{where}", _first_bad(value, bad))


def squares_are_finite(x: Numbers) -> bool:
    """Whether all numbers and their squares surely are: one fast pass, of which the sum may also
    overflow for other reasons."""
    value = np.asarray(x)
    with np.errstate(all="ignore"):
        return bool(np.isfinite(np.vdot(value, value)))


def positive(argument: str, x: Numbers) -> Any:
    """Refuses a value that is not positive; returns it."""
    value = concrete_value(x)
    if value is not None:
        require(_is_numeric(value), argument, "a positive number", Shown(x))
        require(np.all(value > 0), argument, "a positive number", _plain_value(value))
    return x


def positive_number(argument: str, x: Numbers) -> Any:
    """Refuses what is not one positive number, known or not; returns it."""
    require(np.size(x) == 1, argument, "one number", f"shape {np.shape(x)}")
    return positive(argument, x)


def at_least(argument: str, x: Numbers, bound: float) -> Any:
    """Refuses a value below `bound`; returns it."""
    value = concrete_value(x)
    if value is not None:
        require(_is_numeric(value), argument, f"a number >= {bound}", Shown(x))
        require(np.all(value >= bound), argument, f"a number >= {bound}", _plain_value(value))
    return x


def whole(argument: str, x: Numbers, bound: int) -> int:
    """Refuses anything but a Python integer >= `bound` (a size has to be known before tracing)."""
    ok = isinstance(x, int | np.integer) and not isinstance(x, bool) and x >= bound
    require(ok, argument, f"a whole number >= {bound}", Shown(x))
    return int(x)


def psd(argument: str, x: Numbers, definite: bool = False) -> Any:
    """Refuses a matrix that is not square, finite, symmetric and positive (semi)definite."""
    value = concrete_value(x)
    if value is None:
        return x
    kind = "positive definite" if definite else "positive semidefinite"
    square = value.ndim == 2 and value.shape[0] == value.shape[1]
    require(square, argument, "a square matrix", f"shape {value.shape}")
    finite(argument, value)
    # A live filter asks about the same R at every step: small matrices are kept, by their bytes;
    # large ones would fill the table.
    spectrum = _spectrum_of if value.nbytes <= SMALL else _spectrum_of.__wrapped__
    scale, skew, smallest, apart = spectrum(value.astype(float).tobytes(), len(value))
    require(skew <= 1e-5 * scale, argument, "a symmetric matrix", f"asymmetry {skew:.3g}")
    # A singular matrix may have eigenvalues above 0 by rounding, of which an inverse is made.
    eps = np.finfo(value.dtype if value.dtype.kind == "f" else float).eps
    good = apart > len(value) * eps if definite else smallest >= -1e-6 * scale
    require(good, argument, f"a {kind} matrix", f"smallest eigenvalue {smallest:.3g}")
    return x


@lru_cache
def _spectrum_of(raw: bytes, n: int) -> tuple[float, float, float, float]:
    """The largest element of an (n, n) matrix, its asymmetry, its smallest eigenvalue, and that of
    its correlations, which does not depend on units (0 where a variance is not positive)."""
    value = np.frombuffer(raw).reshape(n, n)
    scale = max(np.abs(value).max(initial=0.0), np.finfo(float).tiny)
    skew = np.abs(value - value.T).max(initial=0.0)
    symmetric = (value + value.T) / 2
    variances, apart = np.diag(value), 0.0
    if (variances > 0).all():
        deviations = np.sqrt(variances)
        correlations = symmetric / deviations[:, None] / deviations
        apart = np.linalg.eigvalsh(correlations).min(initial=np.inf)
    return scale, skew, np.linalg.eigvalsh(symmetric).min(initial=np.inf), apart


def prior(prior: Gaussian | None, n: int | None = None) -> None:
    """Refuses a prior with wrong shapes, numbers that are not finite, or a bad covariance."""
    if prior is None:
        return
    ok = isinstance(prior, Gaussian)
    require(ok, "prior", "a Gaussian(mean, cov) or None", type(prior).__name__)
    shape("prior.mean", prior.mean, ("n" if n is None else n,))
    n = np.shape(prior.mean)[0]
    shape("prior.cov", prior.cov, (n, n))
    finite("prior.mean", prior.mean)
    psd("prior.cov", prior.cov)


def needs_prior(prior: Gaussian | None, method: str) -> Gaussian:
    """Refuses `prior=None` for a method that carries a covariance."""
    require(
        prior is not None,
        "prior",
        f"a Gaussian: {method} carries a covariance and cannot start from nothing "
        "(ewif, information and limited_memory can)",
        None,
    )
    assert prior is not None
    return prior


def needs_key(key: RandomKey, method: str) -> Any:
    """Refuses a missing PRNG key, and what is none."""
    require(key is not None, "key", f"a PRNG key (jax.random.key(0)): {method} draws noise", None)
    random_key(key)
    return key


def is_typed_key(x: Numbers) -> bool:
    """Whether these are keys of `jax.random.key`; those of PRNGKey are rows of two numbers."""
    return isinstance(x, Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def random_key(key: RandomKey, runs: int | None = None) -> None:
    """Refuses what is not a PRNG key, nor (with `runs`) typed keys, one for each run."""
    if key is None:
        return
    each = "" if runs is None else f", or {runs} typed keys (jax.random.split(key, {runs}))"
    raw = isinstance(key, Array | np.ndarray) and key.dtype == np.uint32 and key.ndim == 1
    ok = raw or (is_typed_key(key) and key.shape in ((), () if runs is None else (runs,)))
    got = f"{key.dtype} of shape {key.shape}" if isinstance(key, Array | np.ndarray) else Shown(key)
    require(ok, "key", f"a PRNG key (jax.random.key(0)){each}", got)


def estimator(estimator: Any) -> None:
    """Refuses what is not an estimator."""
    ok = isinstance(estimator, Estimator)
    got = f"a {type(estimator).__name__}"
    require(ok, "estimator", "an Estimator (kalman(model), ewif(model, tau), ...)", got)


def stream(measurements: Measurement, batched: bool = False) -> None:
    """Refuses a stream that is empty, ragged, or whose known numbers are not usable.

    A batch of streams has one more leading axis (runs); any field may leave it out when all runs
    share that field.
    """
    ok = isinstance(measurements, Measurement)
    require(ok, "measurements", "a Measurement", type(measurements).__name__)
    time, value, sensor, mask = map(with_dtype, measurements)
    lead = ("R", "T") if batched else ("T",)

    def fits(argument: str, x: Numbers, tail: tuple[int | str, ...]) -> None:
        short = batched and np.ndim(x) == 1 + len(tail)
        shape(argument, x, (*(("T",) if short else lead), *tail))
        each = short or not batched or np.shape(x)[0] == runs
        require(each, argument, f"{runs} runs", np.shape(x)[:1])

    runs = np.shape(value)[0] if np.ndim(value) else 0
    fits("measurements.value", value, ("m",))
    require(not batched or runs > 0, "measurements", "at least one run", "no runs")
    steps, m = np.shape(value)[-2:]
    require(steps > 0, "measurements", "at least one measurement", "an empty stream")
    for argument, x, tail in (("time", time, ()), ("sensor", sensor, ()), ("mask", mask, (m,))):
        fits(f"measurements.{argument}", x, tail)
        length = np.shape(x)[np.ndim(x) - 1 - len(tail)]
        require(length == steps, f"measurements.{argument}", f"{steps} arrivals", length)
    require(mask.dtype == bool, "measurements.mask", "booleans", mask.dtype)
    integer = jnp.issubdtype(sensor.dtype, jnp.integer)
    require(integer, "measurements.sensor", "integers", sensor.dtype)
    finite("measurements.time", time)
    finite("measurements.value", value, mask, " where mask is True (mask out what is missing)")
    seen_sensor = concrete_value(sensor)
    if seen_sensor is not None:
        low, high = seen_sensor.min(), seen_sensor.max()
        require(low >= 0, "measurements.sensor", "indices >= 0", low)
        require(high < 2**31, "measurements.sensor", "indices that fit into int32", high)


def sensor(argument: str, index: int, count: int | None) -> None:
    """Refuses a sensor index outside 0..count-1 (`count` None: no upper bound known)."""
    require(index >= 0, argument, "an index >= 0", index)
    if count is not None:
        have = f"the model has {count} sensor{'s' * (count != 1)}"
        require(index < count, argument, f"an index below {count} ({have})", index)


def sensors(measurements: Measurement, count: int | None) -> None:
    """Refuses a stream whose known sensor indices are not all below `count`."""
    indices = concrete_value(measurements.sensor)
    if indices is not None:
        sensor("measurements.sensor", int(indices.max()), count)


def report_times(times: Numbers, steps: int) -> None:
    """Refuses report times of the wrong length, not finite, or running backwards."""
    shape("times", times, (steps,) if np.ndim(times) < 2 else ("R", steps))
    finite("times", times)
    value = concrete_value(times)
    if value is not None:
        back = np.diff(value) < 0
        place = (*np.argwhere(back)[0],) if back.any() else ()
        later = (*place[:-1], place[-1] + 1) if place else ()
        run = f" in run {place[0]}" if len(place) > 1 else ""
        got = f"{value[later]} after {value[place]}{run}" if place else None
        require(not place, "times", "report times that do not decrease", got)


def _is_numeric(value: np.ndarray) -> bool:
    return jnp.issubdtype(value.dtype, jnp.integer) or jnp.issubdtype(value.dtype, jnp.floating)


def _plain_value(value: np.ndarray) -> Any:
    return value.item() if value.ndim == 0 else value.tolist()


def _first_bad(value: np.ndarray, bad: np.ndarray) -> str:
    """The first bad number and where it is."""
    if not bad.any():
        return ""
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    where = f" at index {index if len(index) != 1 else index[0]}" if index else ""
    return f"{value[index]}{where}"
