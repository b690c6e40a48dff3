"""Sensors that say different numbers of things: each counts with what it has, and no more."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import kalman_loop

import ewif_jax as ej
from ewif_jax.oosm.asd import asd
from laws.cases import close

NOISE = {"r": 0.4, "s": np.array([0.3, 0.2]), "q": 0.2}
TIMES = np.array([0.0, 1.0, 1.5, 2.5, 2.0, 3.0])
SENSOR = np.array([0, 1, 0, 1, 0, 1])
PRIOR = ej.Gaussian(np.array([3.0, 2.0, 0.4, -0.2]), np.diag([2.0, 2.0, 0.5, 0.5]))


def linear_bank(wide: bool) -> ej.Model:
    """A sensor of the velocity, and one of x alone; or, `wide`, one that also sees y, masked."""
    few = [ej.models.position_sensor(lambda p: p["r"], dims=2 if wide else 1)]
    both = [ej.models.velocity_sensor(lambda p: p["s"], dims=2), *few]
    return ej.models.constant_velocity(sensors=both, q=lambda p: p["q"], dims=2)


def seen_twice(params, x, t):
    return jnp.stack([jnp.arctan2(x[1], x[0]), jnp.hypot(x[0], x[1])])


def bent_bank(wide: bool) -> ej.Model:
    """A radar, and a bearing; or, `wide`, two radars, the second with its range masked."""
    radar = ej.models.sensor(seen_twice, lambda p: p["r"], size=2, angle=(True, False))
    few = radar if wide else ej.models.bearing_sensor(lambda p: p["r"])
    return ej.models.constant_velocity(sensors=[radar, few], q=lambda p: p["q"], dims=2)


def rows(seed: int, angles: bool = False) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    # Bearings on both sides of the cut.
    wide = rng.normal(size=(6, 2)) + ([0.3, 3.0] if angles else 0)
    return [wide[k, : 2 - SENSOR[k]] for k in range(6)]


def late_stream(values: list[np.ndarray]) -> ej.types.Measurement:
    return ej.stream(TIMES, values, sensor=SENSOR)


def in_sequence(values: list[np.ndarray]) -> ej.types.Measurement:
    order = np.argsort(TIMES)
    return ej.stream(TIMES[order], [values[k] for k in order], sensor=SENSOR[order])


LINEAR = {
    "kalman": ej.kalman,
    "information": ej.information,
    "square_root": ej.square_root,
    "ewif": lambda model: ej.ewif(model, 2.0),
    "al1": lambda model: ej.al1(model, 4),
}
BENT = {
    "extended": ej.extended,
    "unscented": ej.unscented,
    "asd": lambda model: asd(model, 4),
    "replay": lambda model: ej.replay(ej.extended(model), 4),
    "ensemble": lambda model: ej.ensemble(model, 20),
    "bootstrap": lambda model: ej.bootstrap(model, 30),
}
METHODS = {name: (linear_bank, build) for name, build in LINEAR.items()} | {
    name: (bent_bank, build) for name, build in BENT.items()
}


SLOW = ("square_root", "al1", "replay", "bootstrap", "unscented")
"""What has the code of another; checked with --all."""


@pytest.mark.parametrize(
    ("model", "build"),
    [
        pytest.param(*case, marks=pytest.mark.slow if name in SLOW else (), id=name)
        for name, case in METHODS.items()
    ],
)
def test_a_small_sensor_is_a_wide_one_with_the_rest_masked(model, build):
    stream = late_stream(rows(1, model is bent_bank))
    found, expected = (
        ej.run(build(model(wide)), NOISE, stream, prior=PRIOR, t0=0.0, key=jax.random.key(3))
        for wide in (False, True)
    )
    for a, b in zip(jax.tree.leaves(found[:4]), jax.tree.leaves(expected[:4]), strict=True):
        close(a, b, 1e-12)
    absent = np.asarray(~stream.mask[:, 1])
    assert absent.sum() == 3
    assert (np.asarray(found.info.innovation)[absent, 1] == 0).all()
    unit = np.broadcast_to([0.0, 1.0], (3, 2))
    np.testing.assert_array_equal(np.asarray(found.info.innovation_cov)[absent, 1], unit)


def white(dt: float) -> np.ndarray:
    """Q of a white acceleration of density 1."""
    return np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])


def oracle(values: list[np.ndarray], params: dict = NOISE) -> kalman_loop.Track:
    """The textbook filter, with an H of as many rows as each measurement has numbers."""
    order = np.argsort(TIMES)
    matrices = [np.eye(2, 4, k=2), np.eye(1, 4)]
    noise = [np.diag(np.broadcast_to(params["s"], 2)), np.full((1, 1), params["r"])]
    return kalman_loop.kalman_filter(
        t0=0.0,
        prior_mean=PRIOR.mean,
        prior_cov=PRIOR.cov,
        F=lambda a, b: np.eye(4) + (b - a) * np.eye(4, k=2),
        Q=lambda a, b: params["q"] * np.kron(white(b - a), np.eye(2)),
        times=TIMES[order],
        H=[matrices[k] for k in SENSOR[order]],
        R=[noise[k] for k in SENSOR[order]],
        values=[values[k] for k in order],
    )


def test_the_filter_is_the_textbooks_and_so_is_its_gradient():
    values = rows(2)
    expected = oracle(values)
    estimator = ej.kalman(linear_bank(False))
    trace = ej.run(estimator, NOISE, in_sequence(values), prior=PRIOR, t0=0.0)
    close(trace.mean, expected.means)
    close(trace.cov, expected.covs)
    close(trace.info.log_likelihood, expected.log_likelihoods)

    def total(params):
        found = ej.run(estimator, params, in_sequence(values), prior=PRIOR, t0=0.0)
        return jnp.sum(found.info.log_likelihood)

    slope = jax.grad(total)({name: jnp.asarray(x) for name, x in NOISE.items()})
    for name in ("r", "q"):
        low, high = (
            oracle(values, {**NOISE, name: NOISE[name] + d}).log_likelihoods.sum()
            for d in (-1e-5, 1e-5)
        )
        np.testing.assert_allclose(slope[name], (high - low) / 2e-5, rtol=1e-7)


def test_tables_of_linear_model_may_differ_in_height():
    values = rows(3)
    model = ej.linear_model(
        F=lambda p, a, b: jnp.eye(4) + (b - a) * jnp.eye(4, k=2),
        H=[np.eye(2, 4, k=2), np.eye(1, 4)],
        R=[np.diag(NOISE["s"]), np.full((1, 1), NOISE["r"])],
    )
    expected = oracle(values, {**NOISE, "q": 0.0})
    trace = ej.run(ej.kalman(model), None, in_sequence(values), prior=PRIOR, t0=0.0)
    close(trace.mean, expected.means)
    close(trace.info.log_likelihood, expected.log_likelihoods)


def test_a_batch_and_the_smoothers_take_them_too():
    runs = [rows(seed) for seed in (4, 5)]
    streams = [in_sequence(values) for values in runs]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *streams)
    estimator = ej.kalman(linear_bank(False))
    many = ej.run_batch(estimator, NOISE, batch, prior=PRIOR, t0=0.0)
    single = ej.run(estimator, NOISE, streams[1], prior=PRIOR, t0=0.0)
    close(many.mean[1], single.mean, 1e-12)
    smooth = ej.rts(linear_bank(False), NOISE, streams[1], prior=PRIOR, t0=0.0)
    masked = ej.rts(linear_bank(True), NOISE, streams[1], prior=PRIOR, t0=0.0)
    close(smooth.mean, masked.mean, 1e-12)
    close(smooth.cov[-1], single.cov[-1])


def test_what_a_traced_sensor_lacks_is_absent():
    """Whatever is said to be there: nobody can refuse it any more."""
    stream = late_stream(rows(6))
    estimator = ej.kalman(linear_bank(False))

    @jax.jit
    def filtered(sensor, mask):
        rows = stream._replace(sensor=sensor, mask=mask)
        return ej.run(estimator, NOISE, rows, prior=PRIOR, t0=0.0)

    found, expected = (filtered(stream.sensor, mask) for mask in (stream.mask | True, stream.mask))
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_single_precision():
    values = rows(7)
    short = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == float else x, PRIOR)
    stream = in_sequence([x.astype(np.float32) for x in values])
    trace = ej.run(ej.kalman(linear_bank(False)), NOISE, stream, prior=short, t0=0.0)
    assert trace.mean.dtype == np.float32
    close(trace.mean, oracle(values).means, 1e-5)


MODEL, STREAM = linear_bank(False), in_sequence(rows(8))
TOO_MUCH = STREAM._replace(mask=STREAM.mask | True)
ONE = jax.tree.map(lambda x: x[1], TOO_MUCH)
STATE = ej.kalman(MODEL).init(NOISE, PRIOR, jnp.asarray(0.0))
BATCH = jax.tree.map(lambda x: jnp.stack([x, x]), TOO_MUCH)
GIVEN = {"prior": PRIOR, "t0": 0.0}
ENTRIES = {
    "run": (lambda: ej.run(ej.kalman(MODEL), NOISE, TOO_MUCH, **GIVEN), " at row 1"),
    "run_batch": (
        lambda: ej.run_batch(ej.kalman(MODEL), NOISE, BATCH, **GIVEN),
        " at row 1 of run 0",
    ),
    "run_parallel": (
        lambda: ej.run_parallel(MODEL, NOISE, TOO_MUCH, tau=1.0, **GIVEN),
        " at row 1",
    ),
    "step": (lambda: ej.step(ej.kalman(MODEL), NOISE, STATE, ONE), ""),
    "rts": (lambda: ej.rts(MODEL, NOISE, TOO_MUCH, **GIVEN), " at row 1"),
    "two_sided_ewif": (
        lambda: ej.two_sided_ewif(MODEL, NOISE, TOO_MUCH, tau=1.0, **GIVEN),
        " at row 1",
    ),
    "batch_wls": (
        lambda: ej.batch_wls(MODEL, NOISE, TOO_MUCH, TIMES, weight=lambda p, a, b: 1.0),
        " at row 1",
    ),
    "crlb": (
        lambda: ej.crlb(MODEL, NOISE, TOO_MUCH, state=np.zeros(4), time=3.0),
        " at row 1",
    ),
}


@pytest.mark.parametrize(("call", "place"), ENTRIES.values(), ids=ENTRIES)
def test_a_component_that_a_sensor_lacks_is_refused_before_tracing(call, place):
    with pytest.raises(ValueError, match="nothing present beyond the 1 component of sensor 1") as e:
        call()
    assert str(e.value).endswith(f"got component 1{place}")
    assert str(e.value).startswith("measurement")


REFUSED = {
    "no function": (
        lambda: ej.models.sensor(1.0, 1.0),
        "observe: expected a function (params, x, t), got 1.0",
    ),
    "a variance below 0": (
        lambda: ej.models.sensor(seen_twice, [1.0, -1.0], 2),
        "cov: expected a number >= 0.0, got [1.0, -1.0]",
    ),
    "a covariance of another size": (
        lambda: ej.models.sensor(seen_twice, np.eye(3), 2),
        "cov: expected shape (2, 2), got shape (3, 3)",
    ),
    "angles of another size": (
        lambda: ej.models.sensor(seen_twice, 1.0, 2, [True]),
        "angle: expected shape (2,), got shape (1,)",
    ),
    "angles that are numbers": (
        lambda: ej.models.sensor(seen_twice, 1.0, 2, (0, 1)),
        "angle: expected 2 booleans, got (0, 1)",
    ),
    "no size": (
        lambda: ej.models.sensor(seen_twice, 1.0, 0),
        "size: expected a whole number >= 1, got 0",
    ),
    "another shape than said": (
        lambda: ej.models.sensor(seen_twice, 1.0, 3).observe(None, jnp.ones(2), 0.0),
        "observe: expected shape (3,), got shape (2,)",
    ),
    "no velocity in the state": (
        lambda: ej.models.random_walk(sensors=ej.models.velocity_sensor(1.0, 2), dims=2),
        "sensors: expected a state of at least 4 components for this sensor, got 2",
    ),
    "a position of another size": (
        lambda: ej.models.range_sensor(1.0, (0.0, 0.0), dims=3),
        "position: expected shape (3,), got shape (2,)",
    ),
    "an elevation in the plane": (
        lambda: ej.models.azimuth_elevation_range_sensor(1.0, dims=2),
        "dims: expected 3, since an elevation needs space, got 2",
    ),
    "a bearing on a line": (
        lambda: ej.models.bearing_sensor(1.0, dims=1),
        "dims: expected a whole number >= 2, got 1",
    ),
    "a velocity of another size": (
        lambda: ej.models.range_rate_sensor(1.0, (0.0, 0.0), velocity=(0.0,)),
        "velocity: expected shape (2,), got shape (1,)",
    ),
    "R with other sizes than H": (
        lambda: ej.linear_model(np.eye(2), [np.eye(2), np.eye(1, 2)], [np.eye(1), np.eye(2)]),
        "R: expected as many components as H has, (2, 1), got (1, 2)",
    ),
    "H with other states": (
        lambda: ej.linear_model(np.eye(2), [np.eye(2), np.eye(1, 3)], np.eye(2)),
        "H: expected matrices with equally many columns, got [(2, 2), (1, 3)]",
    ),
}


@pytest.mark.parametrize(("build", "said"), REFUSED.values(), ids=REFUSED)
def test_what_is_refused(build, said):
    with pytest.raises(ValueError, match="expected") as error:
        build()
    assert str(error.value) == said
