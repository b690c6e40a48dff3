"""Tables of pandas and polars become streams of measurements; traces become tables."""

import datetime as dt
from zoneinfo import ZoneInfo

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import ewif_jax as ej

lab = ej.lab
ROWS = {
    "t": [3.0, 1.0, 2.0, 4.0, 5.0],
    "x": [30.0, 10.0, np.nan, 40.0, np.nan],
    "y": [3.0, np.nan, 2.0, 4.0, np.nan],
    "when": [5.0, 2.0, 9.0, 4.0, 10.0],
    "who": ["radar", "camera", "radar", "camera", "radar"],
    "id": ["b", "a", "b", "a", "a"],
}


def frames():
    yield pd.DataFrame(ROWS)
    try:
        import polars as pl
    except ModuleNotFoundError:
        return
    yield pl.DataFrame(ROWS)


@pytest.mark.parametrize("frame", frames(), ids=lambda f: type(f).__module__.split(".")[0])
def test_a_table_becomes_a_stream_in_order_of_arrival(frame):
    found = lab.from_frame(
        frame, time="t", value=["x", "y"], sensor="who", arrival="when", units="ft"
    )
    assert isinstance(found, ej.Measurement)
    np.testing.assert_array_equal(found.time, [1.0, 4.0, 3.0, 2.0])
    np.testing.assert_array_equal(found.value, [[10, 0], [40, 4], [30, 3], [0, 2]])
    np.testing.assert_array_equal(found.mask, [[1, 0], [1, 1], [1, 1], [0, 1]])
    np.testing.assert_array_equal(found.sensor, [0, 0, 1, 1])
    np.testing.assert_array_equal(found.arrival, [2.0, 4.0, 5.0, 9.0])
    np.testing.assert_array_equal(found.row, [1, 3, 0, 2])
    assert found.sensors == ("camera", "radar")
    assert found.dropped == {"with nothing measured": 1}
    assert repr(found) == (
        "4 measurements of 2 numbers in ft by 2 sensors; rows left out: 1 with nothing measured"
    )
    assert repr(jax.tree.map(lambda x: x[:1], found)).startswith("Measurement: 1 arrival")
    tracks = lab.from_frame(frame, time="t", value="x", track="id")
    assert list(tracks) == ["a", "b"]
    np.testing.assert_array_equal(tracks["a"].value[:, 0], [10.0, 40.0])
    model = ej.models.random_walk(sensors=ej.models.position_sensor(1.0), q=1.0)
    prior = ej.Gaussian(np.zeros(1), np.eye(1))
    assert np.isfinite(ej.run(ej.kalman(model), None, tracks["a"], prior=prior, t0=0.0).mean).all()


def test_date_times_with_zones_are_seconds_from_the_first():
    berlin = ZoneInfo("Europe/Berlin")
    # The clock goes back between the second and the third: 120 s pass, not -3480 s.
    start = dt.datetime(2026, 10, 25, 2, 58, tzinfo=berlin)
    utc = [start.astimezone(dt.UTC) + dt.timedelta(seconds=s) for s in (0, 60, 180)]
    local = [x.astimezone(berlin) for x in utc]
    wanted = [0.0, 60.0, 180.0]
    series = {
        "zoned": pd.Series(pd.DatetimeIndex(utc).tz_convert("Europe/Berlin")),
        "utc": pd.Series(pd.DatetimeIndex(utc)),
        "objects": pd.Series(local, dtype=object),
        "no zone": pd.Series(pd.DatetimeIndex(utc).tz_localize(None)),
    }
    for times in series.values():
        frame = pd.DataFrame({"t": times, "x": [1.0, 2.0, 3.0]})
        found = lab.from_frame(frame, time="t", value="x")
        np.testing.assert_array_equal(found.time, wanted)
        assert found.first == np.datetime64("2026-10-25T00:58")
    missing = pd.DataFrame({"t": [pd.NaT, *series["utc"]], "x": [0.0, 1.0, 2.0, 3.0]})
    found = lab.from_frame(missing, time="t", value="x")
    np.testing.assert_array_equal(found.time, wanted)
    assert found.dropped == {"without a time": 1}
    numbers = pd.DataFrame({"t": [1_000, 1_500], "x": [1, 2]})
    np.testing.assert_array_equal(
        lab.from_frame(numbers, time="t", value="x", unit="ms").time, [1.0, 1.5]
    )


def test_degrees_become_metres_across_the_antimeridian_and_at_the_pole():
    degree = 111_319.49  # of longitude at the equator, WGS84
    fiji = pd.DataFrame({"t": [0, 1, 2], "lat": [0.0, 0.0, 91.0], "lon": [179.99, -179.99, 181.0]})
    found = lab.from_frame(fiji, time="t", latlon=("lat", "lon"))
    np.testing.assert_allclose(found.value, [[0, 0], [0.02 * degree, 0]], atol=0.02)
    assert found.dropped == {"beyond the pole": 1}
    assert found.units == "m"
    assert found.origin == (0.0, 179.99)
    pole = pd.DataFrame({"t": [0, 1], "lat": [89.99, 89.99], "lon": [0.0, 180.0]})
    across = lab.from_frame(pole, time="t", latlon=("lat", "lon"))
    np.testing.assert_allclose(across.value[1], [0, 2 * 0.01 * 111_693.9], atol=0.1)
    from ewif_jax.lab.plane import to_degrees

    back = to_degrees(np.asarray(found.value), np.asarray(found.origin))
    np.testing.assert_allclose(back, [[0, 179.99], [0, -179.99]], atol=1e-9)


REFUSED = {
    "no such column": ({"time": "T"}, "time: expected one of the columns t, x"),
    "no value": ({"value": None}, "value: expected columns, or else latlon"),
    "words": ({"value": "who"}, "value: expected numbers in column 'who'"),
    "words as times": ({"time": "who"}, "time: expected numbers or date-times"),
    "a unit": ({"unit": "weeks"}, "unit: expected one of s, ms"),
    "nothing left": ({"value": "none"}, "frame: expected at least one row"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED)
def test_misuse_is_refused(case):
    change, message = case
    frame = pd.DataFrame({**ROWS, "none": [np.nan] * 5})
    with pytest.raises(ValueError, match=message):
        lab.from_frame(frame, **({"time": "t", "value": ["x"]} | change))


MODEL = ej.models.constant_velocity(dims=1, q=1.0, sensors=ej.models.position_sensor(1.0))
PRIOR = ej.Gaussian(np.zeros(2), np.eye(2))


def test_a_trace_becomes_a_table_and_labelled_arrays():
    stream = ej.stream(np.array([1.0, 3.0, 2.0]), np.array([1.0, 2.0, np.nan]))
    trace = ej.run(ej.drop_late(ej.kalman(MODEL)), None, stream, prior=PRIOR, t0=0.0)
    table = lab.to_frame(trace, ["x", "v"])
    assert list(table["status"]) == ["used", "used", "masked"]
    np.testing.assert_array_equal(table["v"], trace.mean[:, 1])
    np.testing.assert_array_equal(table["x_sd"], np.sqrt(trace.cov[:, 0, 0]))
    arrays = lab.to_xarray(trace, ["x", "v"])
    np.testing.assert_array_equal(arrays["mean"].sel(state="v"), trace.mean[:, 1])
    assert arrays["cov"].dims == ("step", "state", "other_state")
    with pytest.raises(ValueError, match="names: expected 2 names"):
        lab.to_frame(trace, ["x"])
    statistics = ej.Statistics(
        {"a": np.ones(3)}, {"a": np.ones(2)}, {"a": np.ones(2)}, {"a": np.zeros(3)}
    )
    assert lab.to_xarray(statistics)["a_over_time_se"].dims == ("step",)
    tuned = ej.Tuned({"q": 1.0}, 0.5, {"loss": np.ones(4), "params": {"q": np.arange(4.0)}}, "done")
    assert lab.to_xarray(tuned)["q"].to_numpy().tolist() == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="found: expected a Trace, Statistics or Tuned"):
        lab.to_xarray(3)


def test_a_state_is_kept_and_goes_on_with_the_same_bits(tmp_path):
    def started(particles):
        bootstrap = ej.bootstrap(MODEL, particles=particles)
        return jax.jit(bootstrap.init)(None, PRIOR, 0.0, jax.random.key(particles))

    late = ej.al1(MODEL, lag=3)
    stream = ej.stream(np.array([1.0, 2.0]), np.array([0.5, 0.7]))
    begun = late.init(None, PRIOR, jnp.asarray(0.0))
    kept = ej.run(late, None, stream, prior=PRIOR, t0=0.0).final_state
    for name, state, like in (("al1", kept, begun), ("bootstrap", started(5), started(5))):
        path = lab.save_state(tmp_path / f"{name}.npz", state)
        again = lab.load_state(path, like)
        assert jax.tree.structure(again) == jax.tree.structure(state)
        for one, two in zip(leaves_of(again), leaves_of(state), strict=True):
            np.testing.assert_array_equal(one, two)
            assert one.dtype == two.dtype
    with pytest.raises(ValueError, match=r"state.*expected .* got .* in .*bootstrap.npz"):
        lab.load_state(tmp_path / "bootstrap.npz", started(6))
    (tmp_path / "bad.npz").write_bytes((tmp_path / "al1.npz").read_bytes()[:-3])
    with pytest.raises(ValueError, match="expected a file of save_state"):
        lab.load_state(tmp_path / "bad.npz", begun)
    with pytest.raises(FileNotFoundError):
        lab.load_state(tmp_path / "none.npz", begun)


def leaves_of(state):
    leaves = jax.tree.leaves(state)
    return [jax.random.key_data(x) if "key" in str(x.dtype) else x for x in leaves]
