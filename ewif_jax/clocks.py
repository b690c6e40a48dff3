"""Times from what people have, and whether the filter's floats can hold them."""

from datetime import UTC, date, datetime, timedelta
from typing import Any, NamedTuple

import numpy as np
from jax import Array

from ewif_jax import checks, plain
from ewif_jax.checks import Shown, require
from ewif_jax.fast.memo import once
from ewif_jax.types import DTypeLike, Numbers

ALL_TO = 1 / 2
MOST_TO = 1 / 50
REMEDY = "subtract the first time, or use float64"


class Stamps(NamedTuple):
    """Date-times (datetime64) or durations (timedelta64), and whether they came with a zone."""

    value: np.ndarray
    zoned: bool


def in_seconds(
    time: Numbers, t0: Numbers = None, times: Numbers = None, name: str = "measurements.time"
) -> tuple[Any, Any, Any]:
    """(time, t0, times) as numbers of seconds.

    Date-times (datetime64, datetime, pandas with or without a time zone) become float64 seconds
    since the first element of `time`; so t0 and times may be date-times too, or seconds since that
    first one. Durations (timedelta64, timedelta) become seconds. Numbers stay as they are.

    Raises:
        ValueError: words, objects, complex numbers, NaT; date-times of some arguments with and of
            others without a zone; t0 or times are date-times, and time is not.
    """
    stamps = _stamps_of(name, time)
    dated = stamps is not None and stamps.value.dtype.kind == "M" and stamps.value.size > 0
    first = stamps.value.flat[0] if stamps is not None and dated else None
    out = [time if stamps is None else _seconds_since(name, stamps, first)]
    for argument, x in (("t0", t0), ("times", times)):
        own = None if x is None else _stamps_of(argument, x)
        if own is not None:
            is_date = own.value.dtype.kind == "M"
            require(dated or not is_date, argument, f"seconds, as in {name}", "date-times")
            same = not is_date or stamps is None or own.zoned == stamps.zoned
            zone = "with" if stamps is not None and stamps.zoned else "without"
            require(same, argument, f"date-times {zone} a time zone, as in {name}", Shown(x))
        out.append(x if own is None else _seconds_since(argument, own, first))
    time, t0, times = out
    if t0 is not None and type(t0) is not float:
        t0 = plain.numbers("t0", t0)
        # A Python number can be remembered by what it is (`checks.once`).
        t0 = t0.item() if isinstance(t0, np.ndarray) and t0.ndim == 0 else t0
    times = None if times is None else plain.numbers("times", times)
    return plain.numbers(name, time), t0, times


def _seconds_since(argument: str, stamps: Stamps, first: Numbers) -> np.ndarray:
    """float64 seconds since `first` of date-times, or of durations."""
    value = stamps.value
    gone = np.isnat(value)
    require(not gone.any(), argument, "a time in every place", f"NaT at index {_bad_place(gone)}")
    unit = np.datetime_data(value.dtype)[0]
    require(unit != "generic", argument, "durations with a unit", value.dtype)
    since = value if value.dtype.kind == "m" else value - first
    return since / np.timedelta64(1, "s")


def _stamps_of(argument: str, x: Numbers) -> Stamps | None:
    """`x` if it is date-times or durations."""
    if isinstance(x, Array | float | int):
        return None
    if getattr(getattr(x, "dtype", None), "tz", None) is not None:
        return Stamps(np.asarray(x, "datetime64[ns]"), True)
    plain.require_unmasked(argument, x)
    value = checks.from_rows(argument, x)
    if value.dtype.kind == "O" and any(isinstance(e, date | timedelta) for e in value.flat):
        return _from_objects(argument, value)
    if value.dtype.kind not in "mM":
        return None
    # A month or a year has no length in seconds.
    if np.datetime_data(value.dtype)[0] in ("Y", "M"):
        require(value.dtype.kind == "M", argument, "durations in weeks or shorter", value.dtype)
        value = value.astype("datetime64[D]")
    return Stamps(plain.native(value), False)


def _from_objects(argument: str, value: np.ndarray) -> Stamps:
    zones = {getattr(e, "tzinfo", None) is not None for e in value.flat}
    require(len(zones) == 1, argument, "date-times that all have a time zone, or none", "both")
    converted = [_from_object(argument, e) for e in value.flat]
    kinds = {e.dtype.kind for e in converted}
    require(len(kinds) == 1, argument, "date-times or durations", "both")
    return Stamps(np.array(converted).reshape(value.shape), zones == {True})


def _from_object(argument: str, x: Numbers) -> Any:
    for method in ("to_datetime64", "to_timedelta64"):  # pandas: in nanoseconds, UTC
        if hasattr(x, method):
            return getattr(x, method)()
    require(isinstance(x, date | timedelta), argument, "date-times", Shown(x))
    if isinstance(x, timedelta):
        return np.timedelta64(x)
    if isinstance(x, datetime) and x.tzinfo is not None:
        x = x.astimezone(UTC).replace(tzinfo=None)
    return np.datetime64(x, "us")


@once
def representable(
    dtype: DTypeLike, time: Numbers, t0: Numbers = None, times: Numbers = None
) -> None:
    """Refuses known times that `dtype` cannot hold.

    All intervals between times that follow each other (stamps of a run, t0 and report times
    together, sorted) have to stay as they are to within a half, and 19 of 20 of them to within a
    fiftieth: in float32 the last holds up to 1.7e5 equal intervals from zero. (In a long stream of
    random times some intervals are so short that their length is of no account.) Times closer than
    both a millionth of the median interval and 1e-10 of themselves, or than rounding in float64,
    are taken for the same. What has that dtype already is not looked at: nobody knows what it was.
    """
    given = ("measurements.time", time), ("t0", t0), ("times", times)
    finer = []
    for argument, x in given:
        value = None if x is None else checks.concrete_value(x)
        if value is not None and value.dtype != dtype and value.dtype.kind in "iuf" and value.size:
            finer.append((argument, value.reshape(-1, value.shape[-1] if value.ndim else 1)))
    runs = max((len(value) for _, value in finer), default=0)
    if not finer:
        return
    # All clocks of a run together, sorted: an interval between a stamp and a report time is asked
    # of the model as well as one between two stamps.
    pool = np.concatenate([np.broadcast_to(x, (runs, x.shape[1])) for _, x in finer], 1)
    ordered = np.sort(pool, axis=1, kind="stable")
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = ordered.astype(dtype).astype(float)
        before = np.diff(ordered).astype(float)
        change = np.abs(np.diff(rounded) - before)
    held = np.isfinite(rounded).all() and (change <= MOST_TO * before).all()
    if not held:
        _judge_times(np.dtype(dtype), finer, ordered.astype(float), rounded, before, change)


def _judge_times(
    dtype: np.dtype,
    given: list[tuple[str, np.ndarray]],
    ordered: np.ndarray,
    rounded: np.ndarray,
    before: np.ndarray,
    change: np.ndarray,
) -> None:
    far = ~np.isfinite(rounded)
    expected = f"times that {dtype} can hold"
    require(not far.any(), given[0][0], expected, ordered[far].flat[0] if far.any() else None)
    size = np.abs(ordered[:, 1:])
    apart = before > 8 * np.finfo(float).eps * size
    some = apart.any(1, keepdims=True)
    # In a run with nothing apart any number will do.
    middle = np.nanmedian(np.where(apart | ~some, before, np.nan), axis=1, keepdims=True)
    apart &= before > np.minimum(1e-6 * middle, 1e-10 * size)
    share = np.where(apart, change / np.where(apart, before, 1), 0)
    many = np.sum(share > MOST_TO, 1) > np.sum(apart, 1) / 20
    lost = (share > ALL_TO).any(1) | many
    if not lost.any():
        return
    run = int(np.argmax(lost))
    k = int(np.argmax(share[run]))
    pair = ordered[run, k : k + 2]
    new = np.diff(rounded[run, k : k + 2])[0]
    ours = [name for name, x in given if np.isin(pair, x[min(run, len(x) - 1)].astype(float)).any()]
    require(
        False,
        ours[-1],
        f"times that {dtype} can tell apart ({REMEDY})",
        f"{pair[0]:.17g} and {pair[1]:.17g}"
        + (f" in run {run}" if len(lost) > 1 else "")
        + f", whose interval of {before[run, k]:.6g} s becomes {new:.6g} s",
    )


@once
def not_ahead(dtype: DTypeLike, time: Numbers, mask: Numbers, times: Numbers, t0: Numbers) -> None:
    """Refuses a known stamp ahead of the filter's clock (`clock="arrival"`), more than rounding."""
    stamp, present, clock, start = map(checks.concrete_value, (time, mask, times, t0))
    if stamp is None or clock is None or present is None:
        return
    stamp, clock = stamp.astype(dtype), clock.astype(dtype)
    clock = clock if start is None else np.maximum(clock, start.astype(dtype))
    ahead = np.atleast_2d((stamp > clock + slack(np, stamp, clock)) & present.any(-1))
    if not ahead.any():
        return
    run, row = np.argwhere(ahead)[0]
    stamp, clock = (np.broadcast_to(x, ahead.shape)[run, row] for x in (stamp, clock))
    require(
        False,
        "measurements.time",
        "stamps that are not ahead of the clock, since clock='arrival' "
        "(times = maximum(times, time), or a latency of that sensor)",
        f"stamp {stamp:.17g} in row {row}"
        + (f" of run {run}" if len(ahead) > 1 else "")
        + f" when the clock shows {clock:.17g}",
    )


def slack(xp: Any, stamp: Numbers, clock: Numbers) -> Any:
    """What rounding may put between two equal times that were computed in different ways."""
    return 4 * xp.finfo(stamp.dtype).eps * xp.maximum(xp.abs(stamp), xp.abs(clock))


def _bad_place(bad: np.ndarray) -> Any:
    place = tuple(int(i) for i in np.argwhere(bad)[0]) if bad.any() else ()
    return place[0] if len(place) == 1 else place
