"""Pictures show what they say: truth black, statuses by mark, bands whose source is named."""

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex

import ewif_jax as ej
from ewif_jax.lab import style

plots = ej.lab.plots
MODEL = ej.models.constant_velocity(
    dims=2, q=0.3, sensors=[ej.models.position_sensor(1.0, dims=2)] * 2
)
STEPS = 60


@pytest.fixture(scope="module")
def seen():
    random = np.random.default_rng(0)
    time = np.arange(STEPS) * 1.0
    truth = np.stack([time, 8 * np.sin(time / 8)], 1)
    value = truth + random.normal(size=truth.shape)
    value[20] = np.nan
    value[59] += 60  # one that arrives in time
    arrival = time + np.where(np.arange(STEPS) % 3 == 1, 2.5, 0)
    stream = ej.stream(time, value, np.arange(STEPS) % 2, arrival=arrival)
    order = ej.arrival_order(arrival)
    prior = ej.Gaussian(np.zeros(4), 10 * np.eye(4))
    trace = ej.run(ej.drop_late(ej.kalman(MODEL)), None, stream, prior=prior, t0=0.0)
    return trace, ej.newest(np.asarray(stream.time), truth[order]), stream, np.sort(arrival)


def texts(ax: Axes) -> list[str]:
    return ax.get_legend_handles_labels()[1]


def lines(ax: Axes) -> dict:
    return {line.get_label(): line for line in ax.get_lines()}


def test_a_track_has_truth_ellipses_and_late_measurements(seen):
    trace, truth, stream, _ = seen
    ax = plots.track(trace, truth, stream)
    assert to_hex(lines(ax)["truth"].get_color()) == style.TRUTH
    assert {"too late", "used", "estimate", "95% ellipse"} <= set(texts(ax))
    assert len(ax.patches) == 12
    late = lines(ax)["too late"].get_xydata()
    assert len(late) == np.sum(np.asarray(trace.info.status) == ej.Status.TOO_LATE)


def test_a_band_says_where_it_comes_from(seen):
    trace, truth, stream, _ = seen
    factor = plots.calibrated_factor(trace, truth)
    nees = np.asarray(ej.nees(trace.mean, trace.cov, np.asarray(truth)))
    assert factor == pytest.approx(np.sqrt(np.mean(nees) / 2))
    cases = {
        "covariance of the filter": {},
        "(calibrated)": {"factor": factor},
        "computed actual error": {"band_cov": np.eye(4)},
    }
    for text, setting in cases.items():
        ax = plots.component(trace, 1, truth, stream, **setting)
        assert any(text in label for label in texts(ax))
    (band,) = ax.collections
    height = np.ptp(band.get_paths()[0].vertices[:, 1])
    assert height == pytest.approx(np.ptp(trace.mean[:, 1]) + 4, rel=0.3)


def test_outliers_are_marked_and_do_not_blow_up_the_axis(seen):
    trace, truth, *_ = seen
    ax = plots.innovations(trace)
    value = np.asarray(ej.nis(trace.info))
    assert ax.get_ylim()[1] < value.max()
    assert any("beyond" in text.get_text() for text in ax.texts)
    ax = plots.consistency(trace, truth)
    assert "χ²(2) over 1 run, 95%" in texts(ax)


def test_arrivals_tuning_and_merit(seen):
    trace, _, stream, arrival = seen
    given = mpl.figure.Figure().subplots()
    assert plots.arrivals(stream, arrival, ax=given) is given
    assert texts(given) == ["sensor 0", "sensor 1", "arrives at once"]
    assert "too late" in texts(plots.arrivals(stream, arrival, trace.info.status))
    history = {"loss": np.array([2.0, 1.0]), "params": {"q": np.array([4.0, 2.0])}}
    ax = plots.history(ej.Tuned({"q": 2.0}, 1.0, history))
    np.testing.assert_array_equal(lines(ax)["q"].get_ydata(), [2, 1])
    ax = plots.landscape(lambda p: (p["q"] - 3) ** 2, "q", [1, 2, 3, 4], {}, error=0.5)
    assert {"3 ± 0.5", "optimum 3", "loss"} == set(texts(ax))
    one = np.eye(1)
    ax = plots.merit_map(one, one, {"radar": (one, one), "camera": (one, 4 * one)}, [0, 1, 2])
    shown = np.asarray([float(text.get_text()) for text in ax.texts]).reshape(2, 3)
    gain = float(ej.random_walk_gain(1.0))
    weak = float(ej.random_walk_gain(0.5))
    np.testing.assert_allclose(shown[0], (1 - gain) ** np.arange(3), atol=0.006)
    np.testing.assert_allclose(shown[1], weak / gain * (1 - weak) ** np.arange(3), atol=0.006)
    with pytest.raises(ValueError, match="trace: expected the Trace of one series"):
        plots.track(None)
