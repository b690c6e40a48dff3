"""A model of constants is the same model as functions of (t0, t1), for every method: over gaps,
masked rows, late rows and report times, in its gradients, and in float32."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from laws.cases import close

PUSH, DT = np.array([0.1, -0.05]), 0.5
H, R = np.array([[1.0, 0.0]]), np.array([[0.4]])


def gathered(params, t0, t1):
    dt = t1 - t0
    return jnp.stack([PUSH[0] * dt + PUSH[1] * dt**2 / 2, PUSH[1] * dt])


def of_intervals(q=lambda p: p["q"]):
    return ej.models.constant_velocity(sensors=ej.models.position_sensor(0.4), q=q, b=gathered)


def of_steps():
    """Its matrices over one step, Q by `params`."""
    model, step = of_intervals(1.0), (jnp.asarray(0.0), jnp.asarray(DT))
    F, b = (np.asarray(fn(None, *step)) for fn in (model.linear.F, model.linear.b))
    unit = np.asarray(model.process_cov(None, *step))
    return ej.linear_model(F, H, R, lambda p: p["q"] * unit, b, dt=DT)


INTERVALS, STEPS = of_intervals(), of_steps()
STREAM = ej.stream(
    DT * np.array([1, 2, 6, 4, 9, 10, 9, 17, 18]),
    np.array([0.3, 0.1, -0.4, 0.2, np.nan, 0.5, 0.7, 0.1, -0.2]),
)
PRIOR = ej.Gaussian(np.array([0.2, -0.1]), np.diag([2.0, 0.5]))
FILTERS = {
    "kalman": ej.kalman,
    "information": ej.information,
    "square_root": ej.square_root,
    "unscented": ej.unscented,
    "ewif": lambda m: ej.ewif(m, 3.0),
    "limited_memory": lambda m: ej.limited_memory(m, 4.0, 6),
    "al1": lambda m: ej.al1(m, 3),
    "bl1": lambda m: ej.bl1(m, 3),
    "asd": lambda m: ej.asd(m, 4),
    "replay": lambda m: ej.replay(ej.kalman(m), 4),
    "rts_reference": lambda m: ej.rts_reference(m, 4),
    "fixed_lag_ewif": lambda m: ej.fixed_lag_ewif(m, 3.0, lag=2 * DT),
    "ensemble": lambda m: ej.ensemble(m, 8),
    "enkf1": lambda m: ej.enkf1(m, 8, 3),
    "bootstrap": lambda m: ej.bootstrap(m, 32),
    "a1": ej.a1,
    "b1": ej.b1,
    "fixed_lag": lambda m: ej.fixed_lag(m, 2),
    "enkf2": lambda m: ej.enkf2(m, 8, 3),
    "pf_retrodict": lambda m: ej.pf_retrodict(m, 32),
}


@pytest.mark.parametrize("name", FILTERS)
def test_filters(name):
    times = np.maximum.accumulate(STREAM.time) + 3 * DT
    traces = [
        ej.run(
            FILTERS[name](model), {"q": 0.3}, STREAM, prior=PRIOR, t0=0.0, times=times,
            key=jax.random.key(0),
        )
        for model in (STEPS, INTERVALS)
    ]  # fmt: skip
    close(traces[0].mean, traces[1].mean, 1e-7)
    close(traces[0].cov, traces[1].cov, 1e-7)
    close(traces[0].info.log_likelihood, traces[1].info.log_likelihood, 1e-7)
    np.testing.assert_array_equal(traces[0].info.status, traces[1].info.status)


def test_smoothers():
    def weight(params, measured, at):
        return jnp.exp(-abs(measured - at) / 6)

    options = {"prior": PRIOR, "t0": 0.0}
    for smooth in (
        lambda m: ej.rts(m, {"q": 0.3}, STREAM, **options),
        lambda m: ej.batch_wls(
            m, {"q": 0.3}, STREAM, DT * np.arange(3.0), weight=weight, **options
        ),
        lambda m: ej.two_sided_ewif(m, {"q": 0.3}, STREAM, tau=3.0, **options),
    ):
        found, expected = smooth(STEPS), smooth(INTERVALS)
        close(found.mean, expected.mean, 1e-9)
        close(found.cov, expected.cov, 1e-9)


def test_gradients_of_q_and_of_a_batch():
    """Also where each run has its own times, so that the steps differ in the batch."""
    streams = ej.Measurement(
        np.stack([STREAM.time, STREAM.time + DT * np.arange(9)]),
        np.stack([STREAM.value, STREAM.value]),
        np.stack([STREAM.sensor, STREAM.sensor]),
        np.stack([STREAM.mask, STREAM.mask]),
    )

    def loss(model, q):
        trace = ej.run_batch(ej.kalman(model), {"q": q}, streams, prior=PRIOR, t0=0.0)
        return jnp.sum(trace.info.log_likelihood)

    found, expected = (
        jax.jit(jax.value_and_grad(lambda q, model=model: loss(model, q)))(0.3)
        for model in (STEPS, INTERVALS)
    )
    close(np.array(found), np.array(expected), 1e-9)


def test_a_transition_from_params_goes_both_ways():
    """F, b and Q by `params`: as the constants, with derivatives as finite differences say."""
    free = ej.linear_model(lambda p: p["F"], H, R, lambda p: p["Q"], lambda p: p["b"], dt=DT)
    one = (jnp.asarray(0.0), jnp.asarray(DT))
    params = {
        "F": STEPS.linear.F(None, *one),
        "Q": STEPS.process_cov({"q": 0.3}, *one),
        "b": STEPS.linear.b(None, *one),
    }

    @jax.jit
    def moved(params, t1):
        return (
            free.linear.F(params, jnp.asarray(0.0), t1),
            free.linear.F(params, t1, jnp.asarray(0.0)),
            free.linear.b(params, jnp.asarray(0.0), t1),
            free.process_cov(params, jnp.asarray(0.0), t1),
        )

    for k in (0, 1, 2, 13, 600):
        t1 = jnp.asarray(k * DT)
        F = np.linalg.matrix_power(np.asarray(params["F"]), k)
        found = moved(params, t1)
        close(found[0], F, 1e-10)
        if k < 20:
            close(found[1], np.linalg.inv(F), 1e-9)
        close(found[2], STEPS.linear.b(None, jnp.asarray(0.0), t1), 1e-10)
        close(found[3], STEPS.process_cov({"q": 0.3}, jnp.asarray(0.0), t1), 1e-10)
    slope = jax.jit(jax.grad(lambda p: sum(jnp.sum(x) for x in moved(p, jnp.asarray(3 * DT)))))
    eps, change = 1e-6, np.array([[0.3, -0.2], [0.1, 0.4]])
    ends = [
        sum(
            float(jnp.sum(x))
            for x in moved({**params, "F": params["F"] + s * eps * change}, 3 * DT)
        )
        for s in (1, -1)
    ]
    np.testing.assert_allclose(
        np.sum(slope(params)["F"] * change), (ends[0] - ends[1]) / (2 * eps), rtol=1e-6
    )
    huge = {**params, "F": 1e30 * params["F"]}
    assert np.isfinite(jax.grad(lambda p: moved(p, 2 * DT)[0].sum())(huge)["F"]).all()


def test_float32():
    data = STREAM._replace(value=np.asarray(STREAM.value, np.float32))
    for name in ("kalman", "ewif"):
        trace = ej.run(FILTERS[name](STEPS), {"q": 0.3}, data, prior=PRIOR, t0=0.0)
        exact = ej.run(FILTERS[name](INTERVALS), {"q": 0.3}, STREAM, prior=PRIOR, t0=0.0)
        assert trace.mean.dtype == np.float32
        close(trace.mean, exact.mean, 1e-5)
        np.testing.assert_array_equal(trace.info.status, exact.info.status)
