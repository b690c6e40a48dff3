"""With `clock="arrival"` nothing may be newer than the clock: refused, or `REJECTED` in a trace."""

import jax
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax import Gaussian, Measurement, Status
from ewif_jax.models import constant_velocity, position_sensor

MODEL = constant_velocity(sensors=position_sensor(0.5), q=0.2)
PRIOR = Gaussian(np.array([0.0, 1.0]), np.eye(2))
TIME, CLOCK = np.array([1.0, 5.0, 2.5]), np.array([1.0, 2.0, 3.0])
STREAM = Measurement(TIME, np.array([[1.2], [9.0], [2.0]]), np.zeros(3, int), np.ones((3, 1), bool))
ESTIMATORS = {"kalman": ej.kalman(MODEL), "asd": ej.asd(MODEL, 3)}
OPTIONS = {"prior": PRIOR, "t0": 0.0, "clock": "arrival"}
MESSAGE = r"measurements\.time: expected stamps .*clock='arrival'.*maximum\(times, time\).*latency"


def test_a_known_stamp_ahead_of_the_clock_is_refused():
    with pytest.raises(ValueError, match=MESSAGE + ".*stamp 5 in row 1 when the clock shows 2"):
        ej.run(ESTIMATORS["kalman"], None, STREAM, times=CLOCK, **OPTIONS)
    batch = STREAM._replace(
        time=np.stack([np.minimum(TIME, CLOCK), TIME]), value=np.stack([STREAM.value] * 2)
    )
    with pytest.raises(ValueError, match=MESSAGE + ".*in row 1 of run 1 when"):
        ej.run_batch(ESTIMATORS["kalman"], None, batch, times=CLOCK, **OPTIONS)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_inside_a_trace_it_is_rejected_and_nothing_moves(name):
    def filtered(time, mask):
        stream = STREAM._replace(time=time, mask=mask)
        return ej.run(ESTIMATORS[name], None, stream, times=CLOCK, **OPTIONS)

    filtered = jax.jit(filtered)
    got = filtered(TIME, STREAM.mask)
    # Without that row the filter would not have stopped at 2 s; the motion in between is the same.
    want = filtered(np.minimum(TIME, CLOCK), np.array([[True], [False], [True]]))
    assert got.info.status[1] == Status.REJECTED
    for x, y in ((got.mean, want.mean), (got.cov, want.cov), (got.time, want.time)):
        np.testing.assert_allclose(x, y, rtol=1e-9)
    np.testing.assert_array_equal(got.info.innovation[1], 0)
    np.testing.assert_array_equal(got.info.innovation_cov[1], [[1.0]])
    assert got.info.log_likelihood[1] == 0
    assert got.info.delay[1] == 2.0 - 5.0
    stopped = jax.jit(lambda time: ej.run(
        ESTIMATORS[name], None, jax.tree.map(lambda x: x[:1], STREAM)._replace(time=time),
        times=CLOCK[:1], **OPTIONS,
    ).final_state)(TIME[1:2])  # fmt: skip
    assert stopped.time == 0.0


def test_masked_rows_rounding_and_t0_are_not_ahead():
    masked = STREAM._replace(mask=np.array([[True], [False], [True]]))
    rounded = STREAM._replace(time=CLOCK * (1 + 2e-16))
    from_t0 = OPTIONS | {"t0": 6.0}
    for stream, options in ((masked, OPTIONS), (rounded, OPTIONS), (STREAM, from_t0)):
        trace = ej.run(ESTIMATORS["kalman"], None, stream, times=CLOCK, **options)
        assert Status.REJECTED not in np.asarray(trace.info.status)
