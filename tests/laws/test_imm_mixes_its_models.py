"""Interacting multiple models are the printed recursion (NumPy), the single filter where there is
only one, exact for late data in a replay, and differentiable in how often models change."""

import contextlib
import io
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from late_streams import problem, stream
from oracles import imm as oracle

import ewif_jax as ej
from ewif_jax import Status

SLOW, FAST = problem(0, 2, m=2), problem(7, 2, m=2)
LIKE = FAST._replace(H=SLOW.H, R=SLOW.R)
TIMES = np.array([0.5, 1.0, 0.8, 1.5, 1.2, 2.0, 2.4, 2.2])
LATE = stream(SLOW, np.random.default_rng(2), TIMES)
ORDER = np.argsort(TIMES, kind="stable")
IN_ORDER = jax.tree.map(lambda x: x[ORDER], LATE)
PARTIAL = IN_ORDER._replace(mask=IN_ORDER.mask & ~(np.arange(16).reshape(8, 2) % 5 == 1))
RATES = np.array([[-0.3, 0.3], [0.8, -0.8]])
START = np.array([0.7, 0.3])


def world(given):
    """The model of `given`'s motion with the sensors of SLOW, for us and for the oracle."""
    motion = given.oracle
    model = ej.linear_model(
        F=given.model.linear.F,
        H=SLOW.H,
        R=lambda p: jnp.asarray(SLOW.R) * (1.0 if p is None else p["r"]),
        Q=given.model.process_cov,
        b=given.model.linear.b,
    )
    return model, {**{k: motion[k] for k in "FQb"}, "H": SLOW.H, "R": SLOW.R}


MODELS, ORACLES = zip(world(SLOW), world(LIKE), strict=True)
PARAMS = {"rates": jnp.asarray(RATES), "r": jnp.asarray(1.0)}


def chances(params, t0, t1):
    return jax.scipy.linalg.expm(params["rates"] * (t1 - t0))


def wanted(data):
    rows = zip(*map(np.asarray, data), strict=True)
    changes = lambda t0, t1: scipy.linalg.expm(RATES * (t1 - t0))  # noqa: E731
    found = oracle.filtered(ORACLES, changes, START, SLOW.prior, 0.0, rows)
    return oracle.Modes(*(np.array(x, object) for x in zip(*found, strict=True)))


def go(estimator, data, params=PARAMS, prior=SLOW.prior, **options):
    return ej.run(estimator, params, data, prior=prior, t0=0.0, **options)


def both(first=ej.kalman, second=None, transition=chances, probabilities=START, **options):
    second = first if second is None else second
    pair = [first(MODELS[0]), second(MODELS[1])]
    return ej.imm(pair, transition, probabilities, **options)


def close(found, expected, rtol=1e-9, atol=1e-9):
    np.testing.assert_allclose(
        np.asarray(found, float), np.stack(list(expected)).astype(float), rtol=rtol, atol=atol
    )


KINDS = {
    "kalman": ej.kalman,
    "square_root": ej.square_root,
    "information": ej.information,
    "extended": ej.extended,
    "iterated_extended": ej.iterated_extended,
    "unscented": ej.unscented,
}
ALWAYS = ("kalman", "information")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in ALWAYS else pytest.mark.slow) for n in KINDS]
)
def test_it_is_the_printed_recursion(name):
    second = ej.kalman if name == "unscented" else KINDS[name]
    trace, right = go(both(KINDS[name], second), PARTIAL), wanted(PARTIAL)
    close(trace.mean, right.mean)
    close(trace.cov, right.cov, rtol=1e-8)
    close(trace.info.log_likelihood, right.log_density)
    np.testing.assert_allclose(
        ej.imm_probabilities(trace.final_state), right.mu[-1].astype(float), rtol=1e-8
    )
    for k, mask in enumerate(np.asarray(PARTIAL.mask)):
        close(trace.info.innovation[k][mask], right.innovation[k])
        close(trace.info.innovation_cov[k][np.ix_(mask, mask)], right.innovation_cov[k])
        assert (trace.info.innovation[k][~mask] == 0).all()


def test_equal_models_are_one_filter():
    plain = go(ej.kalman(MODELS[0]), PARTIAL)
    found = go(ej.imm([ej.kalman(MODELS[0])] * 3, np.full((3, 3), 1 / 3), dt=0.1), PARTIAL)
    close(found.mean, plain.mean)
    close(found.cov, plain.cov)
    for a, b in zip(found.info, plain.info, strict=True):
        close(a, b)


def test_a_model_that_is_certain_is_that_filter():
    for j in range(2):
        known = both(transition=np.eye(2), probabilities=lambda p, j=j: np.eye(2)[j])
        found, plain = go(known, PARTIAL), go(ej.kalman(MODELS[j]), PARTIAL)
        close(found.mean, plain.mean)
        close(found.info.log_likelihood, plain.info.log_likelihood)
        np.testing.assert_array_equal(ej.imm_probabilities(found.final_state), np.eye(2)[j])


def test_steps_are_powers():
    """Rows 2, 1, 3 steps apart; of an array, and of a function of params alone."""
    Pi = np.array([[0.9, 0.1], [0.3, 0.7]])
    log = scipy.linalg.logm(Pi)
    data = jax.tree.map(lambda x: x[:3], IN_ORDER)._replace(time=np.array([0.5, 0.75, 1.5]))
    exact = go(both(), data, PARAMS | {"rates": jnp.asarray(log) / 0.25})
    tables = go(both(transition=Pi, dt=0.25), data)
    powers = go(both(transition=lambda p: p["Pi"], dt=0.25), data, PARAMS | {"Pi": Pi})
    for found in (tables, powers):
        close(found.mean, exact.mean)
        close(found.info.log_likelihood, exact.info.log_likelihood)
    with pytest.raises(ValueError, match=r"expected whole steps of dt = 0\.25 s"):
        go(both(transition=Pi, dt=0.25), data._replace(time=np.array([0.5, 0.8, 1.5])))


def test_late_data_are_exact_in_a_replay():
    modes = both()
    late, in_order = go(ej.replay(modes, 8, width=2), LATE), go(modes, IN_ORDER)
    close(late.mean[-1], in_order.mean[-1])
    close(late.cov[-1], in_order.cov[-1])
    np.testing.assert_allclose(
        ej.imm_probabilities(late.final_state.current),
        ej.imm_probabilities(in_order.final_state),
        rtol=1e-9,
    )
    total = late.info.log_likelihood.sum()
    np.testing.assert_allclose(total, in_order.info.log_likelihood.sum(), rtol=1e-9)
    alone = go(modes, LATE).info.status
    is_late = np.maximum.accumulate(TIMES) > TIMES
    np.testing.assert_array_equal(alone, np.where(is_late, Status.TOO_LATE, Status.USED))


def test_reports_and_forecasts_do_not_mix_what_is_kept():
    modes = both()
    plain = go(modes, IN_ORDER)
    reported = go(modes, IN_ORDER, times=np.asarray(IN_ORDER.time) + 0.13)
    for a, b in zip(
        jax.tree.leaves(reported.final_state), jax.tree.leaves(plain.final_state), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    ahead = np.array([2.7, 3.1])
    forecast = ej.forecast(modes, PARAMS, plain.final_state, ahead)
    for k, time in enumerate(ahead):
        there = modes.predict(PARAMS, plain.final_state, jnp.asarray(time))
        close(forecast.mean[k], modes.estimate(PARAMS, there).mean)
    # In two parts it is another filter.
    halfway = modes.predict(PARAMS, plain.final_state, jnp.asarray(2.7))
    twice = modes.estimate(PARAMS, modes.predict(PARAMS, halfway, jnp.asarray(3.1)))
    assert np.abs(twice.mean - forecast.mean[1]).max() > 1e-6


def test_gradients_are_finite_differences():
    modes = both(probabilities=lambda p: jax.nn.softmax(p["start"]))
    rates = PARAMS["rates"]
    params = {**PARAMS, "start": jnp.asarray([0.4, -0.2])}

    @jax.jit
    @jax.value_and_grad
    def loss(params):
        trace = go(modes, PARTIAL, params)
        return jnp.sum(trace.info.log_likelihood) + jnp.sum(trace.mean) + jnp.sum(trace.cov)

    slope, h = loss(params)[1], 1e-5
    for name, at in (("rates", (0, 1)), ("rates", (1, 1)), ("start", (1,)), ("r", ())):
        up, down = (
            loss(params | {name: params[name].at[at].add(s)})[0] for s in (h, -h)
        )  # fmt: skip
        np.testing.assert_allclose(slope[name][at], (up - down) / (2 * h), rtol=1e-5)
    # A chance of zero has a derivative too: the way out of a model that is never left.
    never = rates.at[0].set(0.0)
    slope = loss(params | {"rates": never})[1]["rates"][0, 1]
    up, also = (loss(params | {"rates": never.at[0, 1].set(s)})[0] for s in (h, 2 * h))
    zero = loss(params | {"rates": never})[0]
    np.testing.assert_allclose(slope, (4 * up - also - 3 * zero) / (2 * h), rtol=1e-4)


def test_float32_and_a_batch_of_runs():
    modes = both()
    one = go(modes, PARTIAL)
    single = go(modes, PARTIAL._replace(value=np.asarray(PARTIAL.value, np.float32)))
    assert single.mean.dtype == np.float32
    np.testing.assert_allclose(single.mean, one.mean, rtol=1e-3, atol=1e-3)
    values = np.stack([PARTIAL.value, PARTIAL.value + 1.0])
    found = ej.run_batch(modes, PARAMS, PARTIAL._replace(value=values), prior=SLOW.prior, t0=0.0)
    for k in range(2):
        alone = go(modes, PARTIAL._replace(value=values[k]))
        np.testing.assert_allclose(found.mean[k], alone.mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            found.final_state.log_probabilities[k], alone.final_state.log_probabilities, atol=1e-8
        )


def test_a_model_of_tiny_probability_is_not_lost():
    """In float32 exp(-200) is zero; its logarithm is not."""
    far = ej.Measurement(
        np.arange(1.0, 7.0), np.zeros((6, 1)), np.zeros(6, np.int32), np.ones((6, 1), bool)
    )
    value = np.array([0.0, 0, 0, 0, 40, 40])[:, None]
    narrow, wide = (ej.linear_model(np.eye(1), np.eye(1), r * np.eye(1)) for r in (1.0, 1e4))
    pair = ej.imm([ej.kalman(narrow), ej.kalman(wide)], np.eye(2))
    prior = ej.Gaussian(np.zeros(1, np.float32), 1e-6 * np.eye(1, dtype=np.float32))
    trace = go(pair, far._replace(value=value.astype(np.float32)), None, prior)
    shares = ej.imm_probabilities(trace.final_state)
    np.testing.assert_allclose(shares, [0, 1], atol=1e-6)
    assert np.isfinite(trace.final_state.log_probabilities).all()
    assert trace.final_state.log_probabilities[0] < -200


def test_angles_on_both_sides_of_a_cut_have_a_mean():
    """Two models predict bearings of 180 degrees less and plus a little."""
    sensor = ej.models.bearing_sensor(1e-4)
    up, down = (
        ej.models.random_walk(sensors=sensor, dims=2, q=1e-6, b=b)
        for b in (push, lambda p, t0, t1: -push(p, t0, t1))
    )
    pair = ej.imm([ej.extended(up), ej.extended(down)], np.eye(2))
    data = ej.stream([1.0], [[3.1]])
    info = go(pair, data, None, ej.Gaussian(np.array([-10.0, 0.0]), 1e-6 * np.eye(2))).info
    np.testing.assert_allclose(info.innovation[0], 3.1 - np.pi, atol=1e-3)
    assert info.innovation_cov[0, 0, 0] < 0.1


def push(params, t0, t1):
    return jnp.stack([0 * t0, t1 - t0])


def test_the_example_prints_what_it_says():
    doc = ej.imm.__doc__
    code = re.search(r"drives nothing::\n\n(.*?)\n\n    Reduces", doc, re.DOTALL)[1]
    said, out = re.findall(r"print\(.*\)  # (.*)", code), io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(re.sub("^ {8}", "", code, flags=re.MULTILINE), {})
    assert out.getvalue().splitlines() == said


def test_what_cannot_be_mixed_is_refused():
    eye, kalman = np.eye(2), ej.kalman(MODELS[0])
    wrong = {
        "transition: expected rows of numbers": (kalman, np.full((2, 2), 0.4)),
        "transition: expected shape": (kalman, np.eye(3)),
        "transition: expected finite": (kalman, np.full((2, 2), np.nan)),
    }
    for message, (estimator, transition) in wrong.items():
        with pytest.raises(ValueError, match=message):
            ej.imm([estimator] * 2, transition)
    with pytest.raises(ValueError, match="transition: expected rows of numbers"):
        go(ej.imm([kalman] * 2, lambda p, t0, t1: 0.3 * jnp.ones((2, 2))), IN_ORDER)
    with pytest.raises(ValueError, match="probabilities: expected numbers in"):
        ej.imm([kalman] * 2, eye, [0.5, 0.6])
    with pytest.raises(ValueError, match="estimators: expected a sequence"):
        ej.imm([], eye)
    with pytest.raises(ValueError, match="estimators: expected a sequence"):
        ej.imm(kalman, eye)
    for kind in (ej.asd(MODELS[0], 3), ej.al1(MODELS[0], 3), ej.ensemble(MODELS[0], 9),
                 ej.bootstrap(MODELS[0], 9), ej.gated(kalman)):  # fmt: skip
        with pytest.raises(ValueError, match=r"estimators\[1\]: expected a filter whose state"):
            go(ej.imm([kalman, kind], eye), IN_ORDER)
    with pytest.raises(ValueError, match="prior: expected a Gaussian: imm"):
        go(ej.imm([kalman] * 2, eye), IN_ORDER, prior=None)
    one, two = (ej.kalman(ej.linear_model(eye, eye, eye, eye, dt=dt)) for dt in (1.0, 2.0))
    with pytest.raises(ValueError, match="dt: expected one step"):
        ej.imm([one, two], eye)
    with pytest.raises(ValueError, match="state: expected a state of `imm`"):
        ej.imm_probabilities(go(kalman, IN_ORDER).final_state)


def test_robust_members_and_gates():
    value = np.array(IN_ORDER.value)
    value[4] += 1e6
    data = IN_ORDER._replace(value=value)
    inside = ej.imm([ej.robust(ej.kalman(m), 2.0) for m in MODELS], chances, START)
    outside = ej.robust(both(), 2.0)
    close(go(inside, data).mean, go(outside, data).mean)
    assert np.abs(go(inside, data).mean).max() < 100
    gate = go(ej.gated(both(), 1 - 1e-12), data)
    np.testing.assert_array_equal(gate.info.status == Status.REJECTED, np.arange(8) == 4)
    assert np.abs(gate.mean).max() < 100
