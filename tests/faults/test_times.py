# ruff: noqa: E501
"""Times: other units and clocks become seconds, what a dtype cannot hold is refused."""

from datetime import UTC, datetime, timedelta, timezone

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax import Gaussian, Measurement, clocks
from ewif_jax.models import constant_velocity, position_sensor
from ewif_jax.streams import arrival_order, newest

pandas = pytest.importorskip("pandas")
MODEL = constant_velocity(sensors=position_sensor(0.5), q=0.2)
PRIOR = Gaussian(np.zeros(2), np.eye(2))
EPOCH = 1_700_000_000
START = np.datetime64("2024-03-31T00:30:00", "ns")
STAMPS = START + np.array([0, 1500, 4000]) * np.timedelta64(1, "ms")
SECONDS = [0.0, 1.5, 4.0]
DATED = {
    "ns": STAMPS,
    "ms": STAMPS.astype("datetime64[ms]"),
    "big-endian": STAMPS.astype(">M8[ns]"),
    "list of datetime64": list(STAMPS),
    "timedelta64": STAMPS - START,
    "naive datetime": [datetime(2024, 3, 31, 0, 30) + timedelta(seconds=s) for s in SECONDS],
    "aware datetime": [datetime(2024, 3, 31, tzinfo=UTC) + timedelta(seconds=s) for s in SECONDS],
    "timedelta": [timedelta(seconds=s) for s in SECONDS],
    "Series": pandas.Series(STAMPS),
    # The clocks of Berlin jump half an hour after the first stamp: seconds do not.
    "Series with zone": pandas.Series(STAMPS).dt.tz_localize("UTC").dt.tz_convert("Europe/Berlin"),
    "Index with zone": pandas.DatetimeIndex(STAMPS, tz="UTC"),
    "Timestamps": [pandas.Timestamp(s) for s in STAMPS],
    "two zones": [
        datetime(2024, 3, 31, 12, tzinfo=UTC),
        datetime(2024, 3, 31, 14, 0, 1, 500_000, tzinfo=timezone(timedelta(hours=2))),
        datetime(2024, 3, 31, 12, 0, 4, tzinfo=UTC),
    ],
}


@pytest.mark.parametrize("name", DATED)
def test_date_times_are_seconds_since_the_first(name):
    with jax.enable_x64(name == "ns"):
        np.testing.assert_allclose(ej.stream(DATED[name], np.zeros(3)).time, SECONDS, rtol=1e-7)


def plain(time, value=np.float32):
    steps = np.shape(time)[-1]
    return Measurement(time, np.ones((steps, 1), value), np.zeros(steps, int), np.ones((steps, 1), bool))  # fmt: skip


def test_a_run_of_date_times_is_a_run_of_seconds():
    options = {"prior": PRIOR, "clock": "validity"}
    t0, reports = START - np.timedelta64(1, "s"), STAMPS + np.timedelta64(1, "s")
    got = ej.run(ej.kalman(MODEL), None, plain(STAMPS), t0=t0, times=reports, **options)
    want = ej.run(
        ej.kalman(MODEL), None, plain(np.array(SECONDS)), t0=-1.0,
        times=np.array(SECONDS) + 1, **options,
    )  # fmt: skip
    np.testing.assert_array_equal(got.mean, want.mean)


ALIKE = {
    "whole seconds": EPOCH + np.arange(3),
    "a list of whole seconds": [EPOCH, EPOCH + 10, EPOCH + 20],
    "an array of JAX": lambda: jnp.asarray(EPOCH + 10 * np.arange(3), jnp.int32),
    "moved, not merged": 1e6 + 0.1 * np.arange(9),
    "moved by a fiftieth of an hour": EPOCH + 3600.0 * np.arange(20),
    "merged with one that is no neighbour": EPOCH + np.array([0.0, 1000.0, 10.0, 990.0]),
    "beyond the range": np.array([0.0, 1e300]),
    "one short interval after a long one": np.array([0.0, 1e6, 1e6 + 0.1]),
}


@pytest.mark.parametrize("name", ALIKE)
def test_what_float32_cannot_hold_is_refused_everywhere(name):
    with jax.enable_x64(False):
        time = ALIKE[name]() if callable(ALIKE[name]) else ALIKE[name]
        entries = (
            lambda: ej.stream(time, np.ones(len(time))),
            lambda: ej.run(ej.kalman(MODEL), None, plain(time), prior=PRIOR, t0=float(time[0])),
            lambda: ej.rts(MODEL, None, plain(time), prior=PRIOR, t0=float(time[0])),
            lambda: ej.batch_wls(MODEL, None, plain(time), [0.0], weight=lambda p, a, b: 1.0),
            lambda: ej.two_sided_ewif(MODEL, None, plain(time), tau=1.0),
            lambda: ej.run_parallel(MODEL, None, plain(time), tau=1.0, prior=None, t0=0.0),
        )
        for entry in entries:
            with pytest.raises(
                ValueError, match=r"^(measurements\.time|t0|times): expected times that"
            ):
                entry()


REFUSED = {
    "t0": ({"t0": EPOCH + 0.0}, np.array([EPOCH + 10.0]), "t0"),
    "reports": ({"times": EPOCH + np.array([0.0, 10.0])}, np.array([0.0, 1.0]), "times"),
    "a date-time for t0": ({"t0": START}, np.array([0.0, 1.0]), "t0: expected seconds"),
    "a zone for t0": ({"t0": datetime(2024, 1, 1, tzinfo=UTC)}, STAMPS[:2], "t0: expected date"),
    "not a time": (
        {},
        np.array([START, np.datetime64("NaT", "s")]),
        "measurements.time: expected a time",
    ),
    "words": ({}, np.array(["2024-01-01", "2024-01-02"]), "measurements.time: expected real"),
    "None": ({}, [0.0, None], "measurements.time: expected real"),
    "complex": ({}, np.array([0.0, 1j]), "measurements.time: expected real"),
    "NaN": ({}, [0.0, np.nan], "measurements.time: expected finite"),
    "masked": ({}, np.ma.masked_array([0.0, 1.0], [0, 1]), "measurements.time: expected an array"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_by_name(name):
    options, time, message = REFUSED[name]
    with jax.enable_x64(False), pytest.raises(ValueError, match=message):
        ej.run(ej.kalman(MODEL), None, plain(time), **{"prior": PRIOR, "t0": 0.0} | options)


def test_times_of_later_runs_are_looked_at():
    times = np.stack([np.arange(3.0), EPOCH + np.arange(3.0)])
    measurements = plain(times)._replace(value=np.ones((2, 3, 1), np.float32))
    with jax.enable_x64(False), pytest.raises(ValueError, match=r"measurements\.time.*in run 1"):
        ej.run_batch(ej.kalman(MODEL), None, measurements, prior=PRIOR, t0=0.0)


def accepted(*given):
    try:
        clocks.representable(np.dtype(np.float32), *given)
    except ValueError:
        return False
    return True


def test_ordinary_streams_are_accepted():
    rng = np.random.default_rng(0)
    tenths = 0.1 * np.arange(100_000)
    assert accepted(tenths)
    assert accepted(tenths, 0.0, tenths + 0.03)
    assert accepted(np.cumsum(np.full(1000, 0.1)), 0.3, 0.1 * np.arange(1, 1001))
    assert all(accepted(np.cumsum(rng.exponential(size=300))) for _ in range(50))
    assert accepted(0.01 * np.arange(100_000))
    assert accepted(np.array([0.3]), 0.1 + 0.2)
    assert accepted(1e9 + 128.0 * np.arange(10))
    assert accepted(np.stack([tenths, tenths[::-1]]))


def test_arrival_sorts_stably():
    arrival = pandas.Series(STAMPS[[2, 0, 2, 1]])
    np.testing.assert_array_equal(arrival_order(arrival), [1, 3, 0, 2])
    stream = ej.stream([1.0, 2.0, 3.0, 4.0], [1.0, np.nan, 3.0, 4.0], [0, 1, 0, 1], arrival=arrival)
    np.testing.assert_array_equal(stream.time, [2.0, 4.0, 1.0, 3.0])
    np.testing.assert_array_equal(stream.mask[:, 0], [False, True, True, True])
    np.testing.assert_array_equal(stream.sensor, [1, 1, 0, 0])
    for xp in (np, jnp):
        truth = newest(xp.array([1.0, 3.0, 2.0, 3.0, 4.0]), xp.arange(10.0).reshape(5, 2))
        np.testing.assert_array_equal(truth[:, 0], [0.0, 2.0, 2.0, 6.0, 8.0])
