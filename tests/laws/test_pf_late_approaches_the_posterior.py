"""What the particle filters for late data converge to on a linear Gaussian model."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from late_streams import exact, problem, stream
from oracles.joint_gaussian import posterior
from particle_runs import deviation, runs

import ewif_jax as ej
from ewif_jax.oosm.pf_extended import pf_extended
from ewif_jax.oosm.pf_fixed_point import pf_fixed_point
from ewif_jax.oosm.pf_retrodict import pf_retrodict

GIVEN = problem(3, 2)
LAG = 4
MANY, FEW = 3200, 200
VARIANTS = {
    "ext": lambda count: pf_extended(GIVEN.model, count, LAG),
    "eks": lambda count: pf_fixed_point(GIVEN.model, count, LAG, "eks"),
    "uks": lambda count: pf_fixed_point(GIVEN.model, count, LAG, "uks"),
    "ps": lambda count: pf_fixed_point(GIVEN.model, count, LAG, "ps", smoother_particles=count),
}
NAMES = [pytest.param(name, marks=pytest.mark.slow if name == "uks" else ()) for name in VARIANTS]
"""uks differs from eks only in its smoother, which has a law test of its own"""
TWO_LATE = (0.5, 1.0, 1.5, 1.2, 2.0, 2.5, 3.0, 2.2)
"""The second late measurement lies after a summary that has taken the first."""
LAST_INTERVAL = (0.5, 1.0, 1.5, 1.4)
OLDER = (0.5, 1.0, 1.5, 0.7)


def last(trace):
    return trace.mean[-1], trace.cov[-1], trace.info


def predictive(data):
    """The last measurement minus what the exact posterior without it expects, and its variance."""
    times, values, sensors, _ = (np.asarray(x) for x in data)
    seen = sensors[:-1]
    mean, cov = posterior(
        times[-1],
        **GIVEN.oracle,
        times=times[:-1],
        H=GIVEN.H[seen],
        R=GIVEN.R[seen],
        values=values[:-1],
    )
    H, R = GIVEN.H[sensors[-1]], GIVEN.R[sensors[-1]]
    return values[-1] - H @ mean, H @ cov @ H.T + R


@cache
def sampled(name, count, keys, times):
    """Mean, covariance and info after the last arrival, in many runs of a variant."""
    data = stream(GIVEN, np.random.default_rng(0), times)
    build = VARIANTS.get(name, lambda count: pf_retrodict(GIVEN.model, count))
    return runs(build(count), data, GIVEN.prior, keys, of=last)


def retrodicted():
    """ERRATA of (87)-(92): H* = H F^-1, R* = R + H* Q H*' instead of the exact update."""
    data = stream(GIVEN, np.random.default_rng(0), OLDER)
    means, covs = exact(GIVEN, data)
    x, P = means[-2], covs[-2]
    F, Q, b = (GIVEN.oracle[name](0.7, 1.5) for name in ("F", "Q", "b"))
    sensor = int(data.sensor[-1])
    H = GIVEN.H[sensor] @ np.linalg.inv(F)
    R = GIVEN.R[sensor] + H @ Q @ H.T
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return x + gain @ (np.asarray(data.value[-1]) - H @ (x - b)), P - gain @ H @ P


@pytest.mark.parametrize("times", [TWO_LATE, LAST_INTERVAL], ids=["two", "last interval"])
@pytest.mark.parametrize("name", NAMES)
def test_the_limit_is_the_exact_posterior(name, times):
    data = stream(GIVEN, np.random.default_rng(0), times)
    mean, cov = (x[-1] for x in exact(GIVEN, data))
    means, covs, info = sampled(name, MANY, 40, times)
    late = np.asarray(times) < np.maximum.accumulate(times)
    assert (info.status == np.where(late, ej.Status.LATE_USED, ej.Status.USED)).all()
    assert deviation(means, mean) < 4
    assert deviation(covs, cov) < 4
    assert means.std(0).max() < 0.2 * np.sqrt(np.diag(cov)).min()
    innovation, S = predictive(data)
    log_density = -0.5 * (innovation @ np.linalg.solve(S, innovation) + np.log(2 * np.pi * S[0, 0]))
    assert deviation(info.innovation[:, -1], innovation) < 4
    assert deviation(info.innovation_cov[:, -1], S) < 4
    assert deviation(info.log_likelihood[:, -1], log_density) < 4


def test_retrodiction_converges_to_another_kalman_update():
    data = stream(GIVEN, np.random.default_rng(0), OLDER)
    truth = (x[-1] for x in exact(GIVEN, data))
    found = sampled("retrodict", MANY, 60, OLDER)
    for samples, claim, other in zip(found, retrodicted(), truth, strict=False):
        assert deviation(samples, claim) < 4
        assert deviation(samples, other) > 8


@pytest.mark.parametrize("name", [*NAMES, "retrodict"])
def test_the_error_falls_as_the_root_of_the_number_of_particles(name):
    """Sixteen times as many: a quarter of the RMS error of the mean, in units of its posterior."""
    times, keys = (OLDER, 60) if name == "retrodict" else (LAST_INTERVAL, 40)
    limit = retrodicted()
    if name != "retrodict":
        limit = [x[-1] for x in exact(GIVEN, stream(GIVEN, np.random.default_rng(0), times))]
    root = np.linalg.cholesky(limit[1])

    def squares(count, keys):
        off = sampled(name, count, keys, times)[0] - limit[0]
        return np.sum(np.linalg.solve(root, off.T) ** 2, 0)

    few, many = squares(FEW, 200), squares(MANY, keys)
    ratio = np.sqrt(few.mean() / many.mean())
    parts = [x.std(ddof=1) / x.mean() / np.sqrt(x.size) for x in (few, many)]
    error = ratio * np.hypot(*parts) / 2
    assert error < 0.6
    assert abs(ratio - 4) < 4 * error


@pytest.mark.parametrize(
    "method",
    [pf_extended(GIVEN.model, 50, LAG), pf_fixed_point(GIVEN.model, 50, LAG)],
    ids=["ext", "eks"],
)
def test_what_is_older_than_the_memory_is_too_late(method):
    """LAG used times before the present one are remembered."""
    times = np.arange(1.0, LAG + 3)
    data = stream(GIVEN, np.random.default_rng(2), times)
    step = jax.jit(lambda state, z: ej.step(method, None, state, z))
    state = method.init(None, GIVEN.prior, 0.0, jax.random.key(0))
    for k in range(len(times)):
        state, _ = step(state, jax.tree.map(lambda x, k=k: x[k], data))
    for age, status in ((LAG, ej.Status.LATE_USED), (LAG + 0.01, ej.Status.TOO_LATE)):
        late = jax.tree.map(lambda x: x[0], data)._replace(time=jnp.asarray(times[-1] - age))
        after, info = step(state, late)
        assert info.status == status
    np.testing.assert_array_equal(after.log_weights, state.log_weights)
