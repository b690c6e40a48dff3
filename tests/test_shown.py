"""Streams and results print as a few readable lines."""

import jax
import numpy as np

import ewif_jax as ej

MODEL = ej.models.constant_velocity(dims=1, q=1.0, sensors=[ej.models.position_sensor(1.0)] * 2)


def test_streams_and_traces_print_as_lines_and_tables():
    stream = ej.stream(np.array([1.0, 3.0, 2.0]), np.array([1.0, 2.0, np.nan]), np.array([0, 1, 0]))
    assert repr(stream).splitlines() == [
        "Measurement: 3 arrivals of 1 number",
        "  time        1 to 3 s",
        "  late        33% of the arrivals",
        "  sensors     0, 1",
        "  missing     1 of 3 numbers",
    ]
    prior = ej.Gaussian(np.zeros(2), np.eye(2))
    trace = ej.run(ej.drop_late(ej.kalman(MODEL)), None, stream, prior=prior, t0=0.0)
    lines = repr(trace).splitlines()
    assert lines[0] == "Trace: 3 arrivals, a state of 2 numbers"
    assert lines[2] == "  measurements  67% used, 33% masked"
    mean, cov = trace.mean[-1], trace.cov[-1]
    assert f"{mean[0]:.4g} ± {np.sqrt(cov[0, 0]):.2g}" in lines[3]
    assert trace._repr_html_().count("<tr>") == len(lines)
    assert "<td style='text-align:left'>1 to 3 s</td>" in stream._repr_html_()


def test_what_is_not_numbers_prints_as_a_tuple():
    flags = ej.Measurement(True, False, None, 0)
    assert repr(flags) == "(True, False, None, 0)"
    assert flags._repr_html_() is None
    seen = []
    stream = ej.stream(np.arange(2.0), np.arange(2.0))
    jax.make_jaxpr(lambda x: seen.append(repr(x)) or x.time)(stream)
    assert seen[0].startswith("(JitTracer") or seen[0].startswith("(")


def test_statistics_print_means_and_roots():
    runs = np.array([1.0, 2.0, 3.0])
    found = ej.Statistics({"a": runs}, {"a": runs}, {"a": runs}, {"a": np.array([0, 2, 0])})
    assert repr(found).splitlines()[1] == (
        "  a          2 ± 0.58, root 1.4142 (2 arrivals left out)"
    )
