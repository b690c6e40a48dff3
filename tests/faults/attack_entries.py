# ruff: noqa: E501
"""Inputs of other kinds, shapes and dtypes: each must be refused by name, or mean what it says."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import ewif_jax as ej
from ewif_jax.models import constant_velocity, position_sensor
from faults.named import is_named

T, R = 6, 3
RNG = np.random.default_rng(3)
TIME = np.arange(1.0, T + 1)
CLEAN = {
    "time": TIME,
    "value": RNG.normal(size=(T, 1)),
    "sensor": np.array([0, 1, 0, 1, 1, 0]),
    "mask": np.array([1, 1, 0, 1, 1, 1], bool)[:, None],
    "mean": np.array([0.5, -0.2]),
    "cov": np.array([[2.0, 0.3], [0.3, 1.0]]),
    "t0": 0.0,
    "q": 0.5,
    "r": 0.25,
    "tau": 2.0,
}
SENSORS = [position_sensor(lambda p: p["r"]), position_sensor(lambda p: 2 * p["r"])]


@cache
def model() -> ej.Model:
    return constant_velocity(sensors=SENSORS, q=lambda p: p["q"])


@cache
def estimators() -> dict[str, ej.Estimator]:
    return {"kalman": ej.kalman(model()), "ewif": ej.ewif(model(), by_tau)}


def by_tau(params: Any) -> Any:
    return params["tau"]


class Change(NamedTuple):
    """field; make: what the clean value becomes; means: the clean value that it stands for (None:
    the clean one), or the string "refused"."""

    name: str
    field: str
    make: Callable[[Any], Any]
    means: Any = None


def _replaced(x: Any, index: Any, new: Any) -> Any:
    x = np.array(x)
    x[index] = new
    return x


_ARRAYS = ("time", "value", "mean", "cov")
_NUMBERS = ("t0", "q", "r", "tau")
REFUSED = "refused"
SAME: tuple[tuple[str, Callable[[Any], Any]], ...] = (
    ("a list", lambda x: np.asarray(x).tolist()),
    ("JAX", jnp.asarray),
    ("big-endian", lambda x: np.asarray(x).astype(np.asarray(x).dtype.newbyteorder(">"))),
    ("not contiguous", lambda x: np.repeat(np.asarray(x), 2, 0)[::2]),
    ("Fortran order", np.asfortranarray),
    (
        "read-only",
        lambda x: np.frombuffer(np.asarray(x).tobytes(), np.asarray(x).dtype).reshape(np.shape(x)),
    ),
)
BAD: tuple[tuple[str, Callable[[Any], Any]], ...] = (
    ("None", lambda x: None),
    ("words", lambda x: np.full(np.shape(x), "one")),
    ("a word", lambda x: "one"),
    ("complex", lambda x: np.asarray(x) + 1j),
    ("a dictionary", lambda x: {"a": x}),
    ("objects", lambda x: np.full(np.shape(x), object(), object)),
    ("NaN", lambda x: np.asarray(x, float) * np.nan),
    ("infinity", lambda x: np.asarray(x, float) + np.inf),
    ("one axis more", lambda x: np.asarray(x)[None]),
)
LESS: tuple[tuple[str, Callable[[Any], Any]], ...] = (
    ("one less", lambda x: np.asarray(x)[:-1]),
    ("one more", lambda x: np.concatenate([np.asarray(x), np.asarray(x)[-1:]])),
    ("none", lambda x: np.asarray(x)[:0]),
    ("one axis less", lambda x: np.asarray(x)[0]),
    ("ragged", lambda x: [np.asarray(x).tolist(), [1.0]]),
)
CHANGES: tuple[Change, ...] = (
    *(Change(n, f, make) for f in (*_ARRAYS, "sensor", "mask") for n, make in SAME),
    *(Change(n, f, make) for f in _NUMBERS for n, make in SAME if n in ("JAX", "big-endian")),
    *(
        Change(n, f, make, REFUSED)
        for f in (*_ARRAYS, "sensor", "mask", *_NUMBERS)
        for n, make in BAD
        # No decay; one number; one variance, of one component.
        if (f, n) not in (("tau", "infinity"), ("tau", "one axis more"), ("r", "one axis more"))
    ),
    *(Change(n, f, make, REFUSED) for f in (*_ARRAYS, "sensor", "mask") for n, make in LESS),
    *(Change("whole numbers", f, lambda x: np.ones(np.shape(x), int), np.ones(np.shape(CLEAN[f]))) for f in ("value", "mean")),
    Change("whole stamps", "time", lambda x: x.astype(int)),
    Change("small unsigned stamps", "time", lambda x: x.astype(np.uint8)),
    Change("durations", "time", lambda x: (x * 1000).astype("timedelta64[ms]")),
    Change("identity of ints", "cov", lambda x: np.eye(2, dtype=int), np.eye(2)),
    Change("bool values", "value", lambda x: np.ones((T, 1), bool), "either"),
    Change("decimal stamps", "time", lambda x: np.array([str(v) for v in x], "U8"), REFUSED),
    Change("int8 sensor", "sensor", lambda x: x.astype(np.int8)),
    Change("uint64 sensor", "sensor", lambda x: x.astype(np.uint64)),
    Change("fractions", "sensor", lambda x: x + 0.5, REFUSED),
    Change("a sensor too many", "sensor", lambda x: _replaced(x, 3, 2), REFUSED),
    Change("negative", "sensor", lambda x: _replaced(x, 3, -1), REFUSED),
    Change("beyond int32", "sensor", lambda x: _replaced(x, 3, 2**32), REFUSED),
    Change("bool sensor", "sensor", lambda x: x.astype(bool), "either"),
    Change("int mask", "mask", lambda x: x.astype(int), "either"),
    Change("float mask", "mask", lambda x: x.astype(float), "either"),
    Change("NaN where masked", "value", lambda x: _replaced(x, 2, np.nan)),
    Change("infinity where masked", "value", lambda x: _replaced(x, 2, np.inf)),
    Change("masked array", "value", lambda x: np.ma.masked_array(x, ~CLEAN["mask"])),
    Change("masked where seen", "value", lambda x: np.ma.masked_array(x, ~CLEAN["mask"][::-1]), REFUSED),
    Change("not symmetric", "cov", lambda x: _replaced(x, (0, 1), 0.9), REFUSED),
    Change("not PSD", "cov", lambda x: _replaced(x, (0, 0), -1.0), REFUSED),
    Change("negative", "q", lambda x: -x, REFUSED),
    Change("negative", "r", lambda x: -x, REFUSED),
    Change("negative", "tau", lambda x: -x, REFUSED),
    Change("zero", "tau", lambda x: 0.0, REFUSED),
    Change("whole", "q", lambda x: 2, 2.0),
    Change("whole", "r", lambda x: np.int32(2), 2.0),
    Change("whole", "tau", lambda x: 2, 2.0),
    Change("a vector", "tau", lambda x: np.full(3, x), REFUSED),
    Change("an array", "r", lambda x: np.full(4, x), REFUSED),
    Change("whole", "t0", lambda x: 0, 0.0),
    Change("later than the first", "t0", lambda x: 1.5, "any"),
)  # fmt: skip
IGNORES = {
    "kalman": {"tau"},
    "ewif": {"q"},
    "parallel": {"q"},
    "two_sided": {"q"},
    "wls": {"q", "tau"},
    "rts": {"tau"},
}
"""Parameters that an entry never asks for may be anything."""


def _stream(x: dict[str, Any]) -> ej.Measurement:
    return ej.Measurement(x["time"], x["value"], x["sensor"], x["mask"])


def _given(x: dict[str, Any]) -> tuple[Any, Any, Any]:
    return {k: x[k] for k in ("q", "r", "tau")}, _stream(x), ej.Gaussian(x["mean"], x["cov"])


def _run(name: str, x: dict[str, Any]) -> Any:
    params, stream, prior = _given(x)
    trace = ej.run(estimators()[name], params, stream, prior=prior, t0=x["t0"])
    return trace.mean, trace.cov, trace.info.status


def _batch(name: str, x: dict[str, Any]) -> Any:
    params, stream, prior = _given(x)
    value = x["value"]
    if isinstance(value, np.ma.MaskedArray):
        value = np.ma.stack([value] * R)
    elif isinstance(value, list):
        value = [value] * R
    elif value is not None:
        value = np.stack([np.asarray(value)] * R)
    stream = stream._replace(value=value)
    trace = ej.run_batch(estimators()[name], params, stream, prior=prior, t0=x["t0"])
    return trace.mean[1], trace.cov[1], trace.info.status[1]


def _loss(name: str, x: dict[str, Any]) -> Any:
    params, stream, prior = _given(x)
    return (ej.likelihood_loss(estimators()[name], stream, prior=prior, t0=x["t0"])(params),)


def _parallel(x: dict[str, Any]) -> Any:
    params, stream, prior = _given(x)
    trace = ej.run_parallel(model(), params, stream, tau=by_tau, prior=prior, t0=x["t0"])
    return trace.mean, trace.cov, trace.info.status


def _rts(x: dict[str, Any]) -> Any:
    params, stream, prior = _given(x)
    return tuple(ej.rts(model(), params, stream, prior=prior, t0=x["t0"]))


def _two_sided(x: dict[str, Any]) -> Any:
    params, stream, prior = _given(x)
    return tuple(ej.two_sided_ewif(model(), params, stream, tau=by_tau, prior=prior, t0=x["t0"]))


def _weight(params: Any, t_l: Any, t_k: Any) -> Any:
    return jnp.exp(-jnp.abs(t_k - t_l) / 2 / params["tau"])


def _wls(x: dict[str, Any]) -> Any:
    params, stream, prior = _given(x)
    found = ej.batch_wls(
        model(), params, stream, np.array([2.0, 6.0]), weight=_weight, prior=prior, t0=x["t0"]
    )
    return tuple(found)


ENTRIES: tuple[tuple[str, str, Callable[[dict[str, Any]], Any]], ...] = (
    ("run kalman", "kalman", lambda x: _run("kalman", x)),
    ("run ewif", "ewif", lambda x: _run("ewif", x)),
    ("run_batch kalman", "kalman", lambda x: _batch("kalman", x)),
    ("run_batch ewif", "ewif", lambda x: _batch("ewif", x)),
    ("run_parallel", "parallel", _parallel),
    ("rts", "rts", _rts),
    ("two_sided_ewif", "two_sided", _two_sided),
    ("batch_wls", "wls", _wls),
    ("likelihood_loss", "kalman", lambda x: _loss("kalman", x)),
)


def attempt(seed: int) -> tuple[str, str]:
    """(kind, what is wrong) of one change to one entry, or beyond all of these of one or two."""
    if seed < len(ENTRIES) * len(CHANGES):
        which, entry = divmod(seed, len(ENTRIES))
        return judged(*ENTRIES[entry], [CHANGES[which]])
    rng = np.random.default_rng([seed, 17])
    label, own, call = ENTRIES[rng.integers(len(ENTRIES))]
    chosen = [CHANGES[k] for k in rng.choice(len(CHANGES), rng.integers(1, 3), replace=False)]
    if len({c.field for c in chosen}) < len(chosen):
        chosen = chosen[:1]
    return judged(label, own, call, chosen)


def judged(label: str, own: str, call: Callable[..., Any], chosen: list[Change]) -> tuple[str, str]:
    if own == "wls":  # its weight is a function of the user
        chosen = [c for c in chosen if c.field != "tau"]
    given, meant = dict(CLEAN), dict(CLEAN)
    for change in chosen:
        given[change.field] = change.make(CLEAN[change.field])
        if change.means is not None and not isinstance(change.means, str):
            meant[change.field] = change.means
    what = f"{label}: " + " and ".join(f"{c.field} {c.name}" for c in chosen)
    told = [c.means for c in chosen if isinstance(c.means, str) and c.field not in IGNORES[own]]
    if label.endswith("loss") and any(c.name == "one axis more" for c in chosen):
        told = ["a batch of one"]  # which a loss takes
    try:
        found = [np.asarray(x) for x in jax.block_until_ready(call(given))]
    except (ValueError, TypeError) as error:
        text = str(error)
        if not is_named(text):
            return "OBSCURE", f"{what}: {type(error).__name__}: {text[:140]!r}"
        if not told and not any(isinstance(c.means, str) for c in chosen):
            return "WRONG", f"{what}: refused, {text[:140]!r}"
        return "refused by name", ""
    except Exception as error:
        return "OBSCURE", f"{what}: {type(error).__name__}: {str(error)[:140]!r}"
    if REFUSED in told:
        return "WRONG", f"{what}: accepted"
    if told:
        return "accepted", ""
    right = [np.asarray(x) for x in call(meant)]
    for a, b in zip(found, right, strict=True):
        if a.dtype.kind == "f" and not np.allclose(a, b, rtol=1e-9, atol=1e-12, equal_nan=True):
            return "WRONG", f"{what}: off by {np.abs(a - b).max():.2g}"
        if a.shape != b.shape or (a.dtype.kind != "f" and (a != b).any()):
            return "WRONG", f"{what}: {a} for {b}"
    return "means what it says", ""
