"""`ewif-jax track` on files that are right, late, repeated, and wrong."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from ewif_jax.study.cli import run
from ewif_jax.study.readings import read
from ewif_jax.study.track_loss import smooth_median
from ewif_jax.study.tracks import batch, degrees

PLANES = Path("/work/shared/data/opensky_plane_states.csv")


def plain_filter(time, value, q=None, tau=None, noise=30.0):
    """One-step prediction errors of a constant-velocity filter, one axis pair, in plain NumPy."""
    interval = np.median(np.diff(time))
    P = np.diag([1e6 * noise**2, 1e6 * (noise / interval) ** 2])
    x, errors = np.array([value[0], [0.0, 0.0]]), []
    for k in range(len(time)):
        h = time[k] - time[max(k - 1, 0)]
        F = np.array([[1, h], [0, 1]])
        x, P = F @ x, F @ P @ F.T
        P = P * np.exp(h / tau) if tau else P + q * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
        innovation, S = value[k] - x[0], P[0, 0] + noise**2
        errors.append(np.hypot(*innovation))
        gain = P[:, :1] / S
        x, P = x + gain * innovation, P - gain @ gain.T * S
    return np.array(errors)


def write(path, text):
    path.write_text(text)
    return path


@pytest.fixture
def two_tracks(tmp_path):
    """Two manoeuvring tracks with epoch times, one late row, two repeats and an empty one."""
    rng, rows = np.random.default_rng(0), []
    for name, speed in (("a", 3.0), ("b", -2.0)):
        time = 1.6e9 + np.cumsum(rng.uniform(0.5, 1.5, 60))
        velocity = speed + np.cumsum(rng.normal(0, 0.5, (60, 2)), 0)
        place = np.cumsum(velocity, 0) + rng.normal(0, 1.0, (60, 2))
        rows += [(t, t + 0.1, name, x, y) for t, (x, y) in zip(time, place, strict=True)]
    frame = pd.DataFrame(rows, columns=["time", "arrival", "track", "x", "y"])
    frame.loc[20, "arrival"] += 3.0
    repeats = frame.iloc[[30, 31]].assign(arrival=lambda f: f["arrival"] + 0.5)
    frame = pd.concat([frame, repeats])
    frame.loc[len(frame)] = (1.6e9 + 200, 1.6e9 + 200, "a", np.nan, np.nan)
    path = tmp_path / "two.csv"
    frame.to_csv(path, index=False)
    return path


def test_late_repeated_and_empty_rows(two_tracks):
    tracks = batch(read(two_tracks))
    assert tracks.present.sum(1).tolist() == [60, 60]
    assert tracks.dropped == {"empty": 1, "repeating an older position": 2}
    time = tracks.measurements.time
    assert time[:, 0].tolist() == [0.0, 0.0]
    assert (np.diff(time[0]) < 0).sum() == 1
    assert np.all(np.diff(tracks.arrival[0]) >= 0)


@pytest.mark.parametrize("estimator", ["ewif", "kalman"])
def test_tuning_finds_a_better_filter(two_tracks, tmp_path, estimator, capsys):
    out = tmp_path / "results"
    given = ["track", str(two_tracks), "--estimator", estimator, "--noise", "1", "--tune"]
    assert run([*given, "--steps", "60", "--out", str(out)]) == 0
    table = pd.read_csv(out / "track" / "track.csv").set_index(["times", "setting"])
    median = table["median error [m]"]
    assert median["validity", "tuned"] <= median["validity", "before"] * 1.001
    assert median["validity", "tuned"] < 3.0
    estimates = pd.read_csv(out / "track" / "estimates.csv")
    late = {"ewif": "late_used", "kalman": "too_late"}[estimator]
    assert (estimates["status"] == late).sum() == 1
    assert estimates["time"].min() > 1.6e9
    assert {"x", "vy", "sd_x", "sd_vy"} <= set(estimates.columns)
    assert "late" in capsys.readouterr().out
    for name in ("tracks", "innovations", "tuning"):
        assert (out / "track" / f"{name}.png").stat().st_size > 20_000


def test_it_is_the_plain_filter(two_tracks, tmp_path):
    """Without late rows the prediction errors are those of a plain NumPy loop."""
    frame = pd.read_csv(two_tracks).query("track == 'b'")
    path = tmp_path / "b.csv"
    frame.to_csv(path, index=False)
    for estimator, setting in (("kalman", {"q": 0.3}), ("ewif", {"tau": 2.0})):
        out = tmp_path / estimator
        parameter = [item for k, v in setting.items() for item in (f"--{k}", str(v))]
        arguments = ["track", str(path), "--estimator", estimator, "--noise", "1", *parameter]
        assert run([*arguments, "--out", str(out)]) == 0
        estimates = pd.read_csv(out / "track" / "estimates.csv")
        plain = plain_filter(
            frame["time"].to_numpy() - 1.6e9, frame[["x", "y"]].to_numpy(), noise=1.0, **setting
        )
        np.testing.assert_allclose(estimates["prediction_error"][5:], plain[5:], rtol=1e-3)


def test_degrees_become_metres_and_back():
    path_like = np.array([[52.0, -1.0], [52.01, -1.02], [52.1, -0.9]])
    frame = pd.DataFrame(path_like, columns=["lat", "lon"]).assign(time=range(3))
    from ewif_jax.study.readings import Columns, Readings

    nothing = np.array([""] * 3)
    time = frame["time"].to_numpy(float)
    columns = Columns("time", None, None, None, ("lat", "lon"), True)
    tracks = batch(Readings(columns, np.arange(3), time, time, nothing, nothing, path_like))
    metres = tracks.measurements.value[0]
    north = 111_260 * 0.01
    assert metres[0] == pytest.approx([0, 0])
    assert metres[1] == pytest.approx([-1372, north], rel=5e-3)
    np.testing.assert_allclose(degrees(tracks.origin[0], metres), path_like, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("time,x,y\n", "no rows"),
        ("time,x,y\n0,1,2\n1,one,2\n", "line 3, column 'x': expected a number, got 'one'"),
        ("time,x,y\n0,1,2\n\n,1,2\n", "line 4, column 'time': expected a number, got ''"),
        ("time,x,y\n0,1,inf\n", "line 2, column 'y': expected a number, got 'inf'"),
        ("stamp,x,y\n0,1,2\n", "which column is the time (--time); it has stamp, x, y"),
        ("time,a,b\n0,1,2\n", "--values or --latlon); it has time, a, b"),
        ("time,lat,lon\n0,52,0\n1,95,0\n", "line 3, column 'lat': expected degrees within ±90"),
        ("time,x,y\n0,1,2\n1,2\n", "line 3, column 'y'"),
        ("time,x,y\n0,1,2\n1,2,3\n", "--warm-up: 5 leaves no measurement"),
    ],
)
def test_bad_files_are_refused_and_nothing_is_written(tmp_path, capsys, text, message):
    path = write(tmp_path / "bad.csv", text)
    assert run(["track", str(path), "--out", str(tmp_path / "results")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert [p.name for p in tmp_path.iterdir()] == ["bad.csv"]


def test_a_column_that_is_not_there_names_those_that_are(tmp_path, capsys):
    path = write(tmp_path / "good.csv", "time,x,y\n0,1,2\n")
    assert run(["track", str(path), "--values", "x,z", "--out", str(tmp_path / "r")]) == 2
    assert "has no column 'z' for --values; it has time, x, y" in capsys.readouterr().err
    assert run(["track", str(tmp_path / "none.csv")]) == 2
    assert "none.csv" in capsys.readouterr().err


def test_sensors_have_their_own_noise(tmp_path, capsys):
    rows = "\n".join(f"{k},{'gps' if k % 2 else 'radar'},{k}.5" for k in range(12))
    path = write(tmp_path / "s.csv", f"time,sensor,x\n{rows}\n")
    out = ["--out", str(tmp_path / "r"), "--model", "random-walk"]
    assert run(["track", str(path), "--noise", "gps=1", *out]) == 2
    assert "'radar'" in capsys.readouterr().err
    assert run(["track", str(path), "--noise", "gps=1,radar=5", *out]) == 0


def test_smooth_median_is_a_median_with_a_gradient():
    rng = np.random.default_rng(1)
    length = jnp.asarray(np.abs(rng.normal(20, 5, 4001))).at[::7].set(jnp.nan)
    assert float(smooth_median(length)) == pytest.approx(float(jnp.nanmedian(length)), rel=0.01)
    wild = length.at[1:400:7].multiply(1e6)
    assert float(smooth_median(wild)) < 1.1 * float(smooth_median(length))

    def of(scale):
        return smooth_median(length * scale**2)

    slope = jax.grad(of)(1.5)
    assert slope == pytest.approx(float(of(1.5 + 1e-5) - of(1.5 - 1e-5)) / 2e-5, rel=1e-5)


@pytest.mark.skipif(not PLANES.exists(), reason="the aircraft positions are not here")
@pytest.mark.parametrize(("estimator", "grid", "known"), [
    ("kalman", {"q": (3.0, 10.0, 30.0)}, 19.5),
    ("ewif", {"tau": (2.0, 4.0)}, 19.9),
])  # fmt: skip
def test_aircraft(tmp_path, estimator, grid, known):
    """The gradient is at least as good as a grid search in plain NumPy, on every fourth track."""
    tracks = batch(read(PLANES), min_points=30)
    assert len(tracks.name) == 61
    some = tracks.name[::4]
    frame = pd.read_csv(PLANES, dtype={"icao24": str})
    path = tmp_path / "some.csv"
    frame[frame["icao24"].isin(some)].to_csv(path, index=False)
    out = tmp_path / "results"
    given = ["track", str(path), "--noise", "30", "--min-points", "30", "--estimator", estimator]
    assert run([*given, "--tune", "--out", str(out)]) == 0
    table = pd.read_csv(out / "track" / "track.csv").set_index(["times", "setting"])
    median = table["median error [m]"]
    (name, values), searched = next(iter(grid.items())), []
    for value in values:
        errors = [
            plain_filter(
                tracks.measurements.time[r, p], tracks.measurements.value[r, p], **{name: value}
            )[5:]
            for r, p in zip(range(0, 61, 4), tracks.present[::4], strict=True)
        ]
        searched.append(np.nanmedian(np.concatenate(errors)))
    assert median["validity", "tuned"] < min(searched) * 1.02
    assert median["validity", "tuned"] < 1.3 * known
    assert median["report", "tuned"] > 2 * median["validity", "tuned"]
