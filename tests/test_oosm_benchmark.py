"""The benchmark of late-data methods measures what it says, against plain NumPy."""

import io
import re
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.oosm import __main__ as command
from benchmarks.oosm import others, report, scores, streams
from benchmarks.oosm.methods import methods

ROOT = Path(__file__).parents[1]
STREAM = "short delays"
CHI_SQUARE_16 = 6.907664, 28.845351
"""Quantiles at 2.5 and 97.5 % of 16 degrees of freedom: four runs of four states."""


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The folder of a quick run with two methods of ours on one stream."""
    folder = tmp_path_factory.mktemp("oosm")
    with redirect_stdout(io.StringIO()):
        command.main(
            ["--quick", "--only", "replay,drop_late", "--streams", STREAM, "--out", str(folder)]
        )
    return folder


def moved(world, x, P, dt):
    F = np.eye(4)
    F[0, 2] = F[1, 3] = dt
    G = np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(2))
    return F @ x, F @ P @ F.T + world.q * G


def corrected(world, x, P, z):
    H = np.eye(2, 4)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + world.r * np.eye(2))
    return x + K @ (z - H @ x), (np.eye(4) - K @ H) @ P


def by_hand(stream, keep_late):
    """A Kalman filter (means (R, T, 4), covariances) that filters again from the start, in order of
    time, all that arrived (keep_late), or leaves out what is late."""
    means, covs = [], []
    for time, value in zip(stream.time, stream.value, strict=True):
        for k in range(len(time)):
            some = np.arange(k + 1)
            newest = np.maximum.accumulate(time[: k + 1])
            some = some[np.argsort(time[some])] if keep_late else some[time[some] >= newest]
            x, P, now = stream.world.mean, stream.world.cov, 0.0
            for i in some:
                x, P = moved(stream.world, x, P, time[i] - now)
                x, P = corrected(stream.world, x, P, value[i])
                now = time[i]
            means.append(x)
            covs.append(P)
    shape = stream.time.shape
    return np.reshape(means, (*shape, 4)), np.reshape(covs, (*shape, 4, 4))


def test_the_scores_are_those_of_plain_numpy(written):
    table = pd.read_csv(written / "table.csv").set_index("method")
    assert list(table.index) == [report.EXACT, "replay", "drop_late"]
    stream = streams.drawn(STREAM, 4, 30, 0)
    exact = by_hand(stream, True)
    dropped = by_hand(stream, False)
    for name, (mean, cov) in {"replay": exact, report.EXACT: exact, "drop_late": dropped}.items():
        row = table.loc[name]
        error = mean - stream.truth
        by_run = (error[..., :2] ** 2).sum(-1).mean(1)
        np.testing.assert_allclose(row["rmse"], np.sqrt(by_run.mean()), rtol=1e-9)
        spread = by_run.std(ddof=1) / np.sqrt(4) / (2 * np.sqrt(by_run.mean()))
        np.testing.assert_allclose(row["rmse_error"], spread, rtol=1e-9)
        off = np.sqrt(((mean - exact[0])[..., :2] ** 2).sum(-1).mean())
        np.testing.assert_allclose(row["off"], off, rtol=1e-9, atol=1e-9)
        nees = np.einsum("rti,rtij,rtj->rt", error, np.linalg.inv(cov), error)
        np.testing.assert_allclose(row["nees"], nees.mean(), rtol=1e-8)
        low, high = CHI_SQUARE_16[0] / 4, CHI_SQUARE_16[1] / 4
        inside = ((nees.mean(0) >= low) & (nees.mean(0) <= high)).mean()
        np.testing.assert_allclose(row["inside"], inside)
    assert table.loc["drop_late", "off"] > 0.1
    assert table.loc["replay", "numbers"] > table.loc["drop_late", "numbers"] == 15


def test_table_and_figure_are_whole_files(written):
    assert {path.name for path in written.iterdir()} == {"table.csv", "table.md", "figure.png"}
    assert (written / "figure.png").read_bytes()[:4] == b"\x89PNG"
    text = (written / "table.md").read_text()
    assert text.startswith("4 runs of 30 rows, seed 0; ewif_jax ")
    assert "| replay | 0 |" in text


@pytest.mark.parametrize("name", streams.CASES)
def test_a_stream_is_fixed_and_late_as_it_says(name):
    stream, again = (streams.drawn(name, 40, 60, 3) for _ in range(2))
    for x, y in zip(stream[3:], again[3:], strict=True):
        np.testing.assert_array_equal(x, y)
    case = streams.CASES[name]
    assert np.all(np.diff(stream.now, axis=1) >= 0)
    waited = stream.now - stream.time
    assert waited.min() >= -1e-12
    assert waited.max() <= 10 + 1
    assert abs((~stream.there).mean() - case.lost) < 0.03
    assert abs(stream.label.mean() - case.outliers) < 0.02
    if not stream.world.jitter:
        assert abs((waited > 1e-9).mean() - case.late) < 0.03
    # As many measurements as a method keeps are all that is newer than a late one.
    newer = [(row[: k + 1] > t).sum() for row in stream.time for k, t in enumerate(row)]
    assert max(newer) <= streams.LAG
    if stream.world.is_linear:
        arrived = stream.label == 0
        noise = stream.value - stream.truth[..., :2]
        in_order = (stream.newest == stream.time) & stream.there & arrived
        if not stream.world.jitter:
            assert abs(noise[in_order].std() - 1) < 0.05


def test_the_truth_moves_as_the_methods_are_told():
    """A step of the target has the covariance Q, and the start that of the prior."""
    stream = streams.drawn("in sequence", 4000, 2, 0)
    x, world = stream.truth, stream.world
    step = x[:, 1] - x[:, 0] @ world.F(1.0).T
    np.testing.assert_allclose(np.cov(step.T), world.Q(1.0), atol=0.01)
    start = world.F(1.0) @ world.cov @ world.F(1.0).T + world.Q(1.0)
    np.testing.assert_allclose(np.cov(x[:, 0].T), start, atol=0.4)


class Exact:
    """The same filter again from the start, as a method of one arrival at a time."""

    def __init__(self, world):
        self.world, self.seen = world, []

    def arrive(self, now, time, value):
        self.seen = sorted([*self.seen, (time, *value)])
        x, P, before = self.world.mean, self.world.cov, 0.0
        for time, *value in self.seen:
            x, P = corrected(self.world, *moved(self.world, x, P, time - before), value)
            before = time
        return x, P


def test_a_method_of_one_arrival_at_a_time_is_scored_alike_and_lost_rows_are_left_out():
    stream = streams.drawn("lost data", 3, 12, 0)
    found = scores.found_by(Exact, stream)
    row = scores.scored(found, found, stream)
    error = ((found.mean - stream.truth)[..., :2] ** 2).sum(-1)
    by_run = [e[there].mean() for e, there in zip(error, stream.there, strict=True)]
    np.testing.assert_allclose(row["rmse"], np.sqrt(np.mean(by_run)))
    assert np.isnan(found.mean[~stream.there]).all()
    assert row["off"] == 0
    assert row["live_us"] > 0


def test_the_best_of_several_is_taken_on_other_runs():
    class Off(Exact):
        def __init__(self, world, shift):
            super().__init__(world)
            self.shift = shift

        def arrive(self, now, time, value):
            return super().arrive(now, time, value + self.shift)

    candidates = [lambda world, shift=shift: Off(world, shift) for shift in (3.0, 0.0, -1.0)]
    assert scores.best_of(candidates, streams.drawn(STREAM, 2, 8, 1)) is candidates[1]


def test_a_library_that_is_missing_is_said_to_be(monkeypatch):
    def missing(world):
        raise ModuleNotFoundError("No module named 'kalbee'", name="kalbee")

    monkeypatch.setattr(command, "OTHERS", {"theirs": [missing]})
    monkeypatch.setattr(command, "methods", lambda world: {})
    monkeypatch.setattr(command, "reference", lambda world: Exact)
    rows = command.rows_of(
        streams.drawn(STREAM, 2, 6, 0), streams.drawn(STREAM, 2, 6, 1), None, False
    )
    assert [row["note"] for row in rows] == ["", "kalbee is not installed"]
    assert "theirs: kalbee is not installed." in report.markdown(pd.DataFrame(rows))


@pytest.mark.parametrize(
    ("name", "library", "exact"),
    [
        ("FilterPy (late as current)", "filterpy", False),
        ("kalbee buffer (50)", "kalbee", True),
        ("Stone Soup ASD", "stonesoup", False),
    ],
)
def test_the_filters_of_others_are_the_kalman_filter_in_sequence(name, library, exact):
    pytest.importorskip(library)
    (build,) = others.OTHERS[name]
    for which in ["in sequence", *["heavy delays"] * exact]:
        stream = streams.drawn(which, 1, 14, 0)
        ours, theirs = (scores.found_by(method, stream) for method in (Exact, build))
        np.testing.assert_allclose(theirs.mean, ours.mean, atol=1e-7)
        np.testing.assert_allclose(theirs.cov, ours.cov, atol=1e-7)


def test_a_buffer_that_waits_for_everything_is_exact_until_then():
    pytest.importorskip("filterpy")
    stream = streams.drawn(STREAM, 1, 14, 0)
    late = stream._replace(now=stream.now + np.linspace(0, 1e-6, 14))

    class Waits(others.FilterPyBuffer):
        def __init__(self, world):
            super().__init__(world, 2.0)

        def arrive(self, now, time, value):
            super().arrive(now, time, value)
            return self.kf.x, self.kf.P

    found = scores.found_by(Waits, late)
    released = stream.time[0] <= late.now[0, -1] - 2.0
    x, P, before = stream.world.mean, stream.world.cov, 0.0
    for k in np.argsort(stream.time[0]):
        if released[k]:
            step = stream.time[0, k] - before
            x, P = corrected(stream.world, *moved(stream.world, x, P, step), stream.value[0, k])
            before = stream.time[0, k]
    np.testing.assert_allclose(found.mean[0, -1], x, atol=1e-9)
    np.testing.assert_allclose(found.cov[0, -1], P, atol=1e-9)


def test_a_file_is_a_stream(tmp_path):
    rng = np.random.default_rng(0)
    rows = 12
    frame = pd.DataFrame(
        {"t": np.tile(np.arange(rows), 2) + 100.0, "who": ["a"] * rows + ["b"] * rows}
    )
    frame["came"] = frame["t"] + rng.uniform(0, 3, 2 * rows)
    frame["east"], frame["north"] = frame["t"] * 2, rng.normal(size=2 * rows)
    path = tmp_path / "plane.csv"
    frame.to_csv(path, index=False)
    given = ["--time", "t", "--arrival", "came", "--value", "east,north", "--track", "who"]
    with redirect_stdout(io.StringIO()) as said:
        table = command.main(
            ["--file", str(path), *given, "--runs", "2", "--steps", "10", "--only", "drop_late",
             "--out", str(tmp_path / "found")]
        )  # fmt: skip
    row = table[table["method"] == "drop_late"].iloc[0]
    assert row["off"] > 0
    assert np.isnan(row["rmse"])
    assert "Error of the position" not in said.getvalue()


def test_every_method_has_one_row_name():
    worlds = [case.world for case in streams.CASES.values()]
    assert sum(len(set(methods(world))) >= 13 for world in worlds) == len(worlds)


PAGE = ROOT / "docs" / "oosm-benchmark.md"


def test_the_page_shows_the_table_that_was_written_and_its_example_runs():
    page = PAGE.read_text()
    table = pd.read_csv(ROOT / "docs" / "oosm-benchmark.csv")
    assert report.markdown(table) in page
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    said = io.StringIO()
    with redirect_stdout(said):
        exec(compile(example, "oosm-benchmark.md", "exec"), {})
    assert said.getvalue().splitlines() == re.findall(
        r"^print\(.*\)  # (.+)$", example, re.MULTILINE
    )
    own = example[example.index("class ") : example.index("\n\n\nstream =")]
    assert own.count("\n") < 15
