# ruff: noqa: E501
"""Values, sensors, masks and parameters are used as they are meant, or refused by name."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax import Gaussian, Measurement
from ewif_jax.models import constant_velocity, position_sensor
from ewif_jax.scenarios.delays import deliver


@cache
def kalman(double):
    """One filter for each precision: a model's constants are made when it is built."""
    del double
    sensors = [position_sensor(lambda p: p["r"]), position_sensor(lambda p: 2 * p["r"])]
    return ej.kalman(constant_velocity(sensors=sensors, q=1.0))


PRIOR = Gaussian(np.array([0.0, 1.0]), np.array([[2.0, 0.5], [0.5, 1.0]]))
PLAIN = Measurement(
    np.arange(1.0, 4), np.array([[1.0], [3.0], [2.0]]), np.array([0, 1, 0]), np.ones((3, 1), bool)
)
TIME = np.arange(3.0)
REFUSED = {
    "fractions": ({"sensor": [0.9, 1.9, 0.2]}, "sensor: expected whole numbers, got 0.9"),
    "beyond int32": ({"sensor": np.array([0, 2**32, 1])}, "sensor: expected indices"),
    "a negative one": ({"sensor": -1}, "sensor: expected indices"),
    "NaN": ({"sensor": [0.0, np.nan, 1.0]}, "sensor: expected whole"),
    "None among sensors": ({"sensor": [0, None, 1]}, "sensor: expected real"),
    "sensors in words": ({"sensor": ["a", "b", "c"]}, "sensor: expected real"),
    "too few sensors": ({"sensor": [0, 1]}, "sensor: expected shape"),
    "words": ({"mask": ["False", "True", "False"]}, "mask: expected booleans"),
    "numbers": ({"mask": [np.nan, 0.3, 0.0]}, "mask: expected booleans"),
    "twos": ({"mask": [2, 0, 1]}, "mask: expected booleans"),
    "None among masks": ({"mask": [True, None, True]}, "mask: expected booleans"),
    "another length": ({"mask": [True, False]}, "mask: expected shape"),
    "complex": ({"value": np.array([0, 1 + 5j, 2])}, "value: expected real numbers, got complex"),
    "words for values": ({"value": ["1", "2", "3"]}, "value: expected real numbers"),
    "objects": (
        {"value": np.array([1.0, "2", 3], object)},
        "value: expected real numbers, got '2'",
    ),
    "NaN time": ({"time": [0.0, np.nan, 1.0]}, "time: expected finite"),
    "date-times for values": ({"value": TIME.astype("M8[s]")}, "value: expected real numbers"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_stream_casts_nothing_without_a_word(name):
    fields, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        ej.stream(**{"time": TIME, "value": TIME} | fields)


def test_what_is_missing_is_masked():
    masked = np.ma.masked_array([1.0, -9999.0, 3.0], mask=[False, True, False])
    for value, mask in ((masked, None), ([1.0, None, 3.0], None), (masked, [True, True, True])):
        stream = ej.stream(TIME, value, mask=mask)
        np.testing.assert_array_equal(stream.mask[:, 0], [True, False, True])
        np.testing.assert_array_equal(stream.value[:, 0], [1.0, 0.0, 3.0])
    np.testing.assert_array_equal(ej.stream(TIME, TIME, mask=[1, 0, 1]).mask[:, 0], [1, 0, 1])
    delivered = deliver(TIME, np.array([[1.0], [np.nan], [3.0]]), 0.5).measurements
    np.testing.assert_array_equal(delivered.mask[:, 0], [True, False, True])
    np.testing.assert_array_equal(delivered.value[:, 0], [1.0, 0.0, 3.0])


def last(measurements=PLAIN, prior=PRIOR, params=None, t0=0.0):
    params = {"r": 1.0} if params is None else params
    estimator = kalman(jax.config.values["jax_enable_x64"])
    return np.asarray(ej.run(estimator, params, measurements, prior=prior, t0=t0).mean[-1])


def big(x):
    return x.astype(x.dtype.newbyteorder(">"))


def test_other_byte_orders_and_numbers_are_the_same_data():
    pandas = pytest.importorskip("pandas")
    want = last()
    for field in Measurement._fields:
        got = last(PLAIN._replace(**{field: big(getattr(PLAIN, field))}))
        np.testing.assert_array_equal(got, want, err_msg=field)
    for field in Gaussian._fields:
        np.testing.assert_array_equal(last(prior=PRIOR._replace(**{field: big(getattr(PRIOR, field))})), want)  # fmt: skip
    for r in (1, np.int32(1), np.array(1), np.array(1.0, ">f8"), jnp.asarray(1), np.float16(1)):
        np.testing.assert_allclose(last(params={"r": r}), want, rtol=1e-12, err_msg=repr(r))
    frame = pandas.DataFrame({"t": [1, 2, 3], "z": [1.0, 3.0, 2.0], "s": [0, 1, 0], "m": True})
    columns = Measurement(frame.t, frame[["z"]], frame.s, frame[["m"]])
    np.testing.assert_array_equal(last(columns), want)
    np.testing.assert_array_equal(last(ej.stream(frame.t, frame.z, frame.s, frame.m)), want)
    batch = PLAIN._replace(value=big(np.stack([PLAIN.value] * 2)))
    prior = Gaussian(*map(big, PRIOR))
    many = ej.run_batch(kalman(True), {"r": np.ones(2, ">f8")}, batch, prior=prior, t0=0.0, params_per_run=True)  # fmt: skip
    np.testing.assert_allclose(many.mean[:, -1], [want, want], rtol=1e-12)


def test_no_filter_runs_in_half_precision():
    value = np.linspace(0, 30, 3)[:, None]
    with jax.enable_x64(False):
        want = last(PLAIN._replace(value=value.astype(np.float16).astype(np.float32)))
        for half in (value.astype(np.float16), jnp.asarray(value, jnp.float16)):
            got = last(PLAIN._replace(value=half))
            assert got.dtype == np.float32
            np.testing.assert_array_equal(got, want)
        assert ej.stream(TIME, value.astype(jnp.bfloat16)).value.dtype == np.float32


WRONG = {
    "masked values": (lambda: last(PLAIN._replace(value=np.ma.masked_array(PLAIN.value, [[0], [1], [0]]))), r"measurements\.value: expected an array without"),
    "a masked prior": (lambda: last(prior=PRIOR._replace(mean=np.ma.masked_array([0.0, 1.0], [0, 1]))), r"prior\.mean: expected an array without"),
    "complex values": (lambda: last(PLAIN._replace(value=PLAIN.value + 0j)), r"measurements\.value: expected real"),
    "a complex prior": (lambda: last(prior=PRIOR._replace(mean=np.array([0.0, 1j]))), r"prior\.mean: expected real"),
    "words for parameters": (lambda: last(params={"r": "1"}), r"params\['r'\]: expected numbers, got '1'"),
    "whole numbers that wrap": (lambda: narrow(lambda: last(params={"r": np.array(2**40)})), r"params\['r'\]: expected whole"),
    "a sensor beyond int32": (lambda: last(PLAIN._replace(sensor=np.array([0, 2**32, 0]))), r"measurements\.sensor: expected indices that fit"),
}  # fmt: skip


def narrow(call):
    with jax.enable_x64(False):
        return call()


@pytest.mark.parametrize("name", WRONG)
def test_refused_by_name(name):
    attempt, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        attempt()


def test_float64_may_be_switched_on_and_off():
    got = []
    for double in (False, True, False):
        with jax.enable_x64(double):
            got.append(last(ej.stream(PLAIN.time, PLAIN.value, PLAIN.sensor)))
    assert [x.dtype for x in got] == [np.float32, np.float64, np.float32]
    np.testing.assert_allclose(got[0], got[1], rtol=1e-5)
