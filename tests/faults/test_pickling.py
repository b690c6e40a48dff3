"""What a builder made is a value: equal when made alike, and it travels to other processes."""

import copy
import operator
import pickle
from time import process_time
from timeit import repeat

import cloudpickle
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.monte_carlo import _simulate_runs
from ewif_jax.transforms import Transform

TRACES = {"F": 0}


def F(params, t0, t1):
    TRACES["F"] += 1
    return jnp.eye(2)


def q_of(params):
    return params["q"]


def simulate(key):
    time = jnp.arange(3.0)
    return ej.Simulation(ej.stream(time, jax.random.normal(key, (3, 1))), jnp.zeros((3, 1)))


def counted_model(H=(1.0, 0.0)):
    return ej.linear_model(F, np.array([H]), R=np.eye(1))


def moving_model(q=0.1, r=1.0):
    return ej.models.constant_velocity(sensors=ej.models.position_sensor(r), q=q)


def halved(x):
    return x / 2


def doubled(x):
    return x * 2


BUILT = {
    "model": moving_model,
    "model of a function": lambda: moving_model(q_of),
    "model of arrays": lambda: ej.linear_model(np.eye(2), np.eye(1, 2), np.eye(1), Q=jnp.eye(2)),
    "sensors": lambda: ej.models.bearing_sensor(np.eye(1), position=[1.0, 2.0]),
    "kalman": lambda: ej.kalman(moving_model()),
    "ewif": lambda: ej.ewif(moving_model(), tau=2.0),
    "ewif of params": lambda: ej.ewif(moving_model(), tau=q_of),
    "bootstrap": lambda: ej.bootstrap(moving_model(), 10),
    "wrapped": lambda: ej.selective(ej.replay(ej.kalman(moving_model()), lag=3), max_delay=1.0),
    "fixed lag": lambda: ej.fixed_lag_ewif(moving_model(), 2.0, lag=1.0),
    "scenario": ej.scenarios.sine,
    "scenario with arrays": lambda: ej.scenarios.random_walk(q=jnp.asarray(2.0)),
    "positive": ej.transforms.positive,
    "psd": ej.transforms.psd,
}
BY_HAND = {
    "estimator": lambda: ej.Estimator(halved, doubled, halved, doubled),
    "transform": lambda: Transform(halved, doubled),
}


@pytest.mark.parametrize("name", BUILT | BY_HAND)
def test_equal_things_are_equal_and_travel(name):
    make = (BUILT | BY_HAND)[name]
    thing, again = make(), make()
    assert thing is not again
    assert thing == again
    assert operator.ne(thing, again) is False
    assert hash(thing) == hash(again)
    for back in (
        pickle.loads(pickle.dumps(thing)),
        cloudpickle.loads(cloudpickle.dumps(thing)),
        copy.deepcopy(thing),
        copy.copy(thing),
    ):
        assert type(back) is type(thing)
        assert back == thing
        assert hash(back) == hash(thing)
    assert len({thing, again}) == 1


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (moving_model(0.1), moving_model(0.2)),
        (moving_model(1), moving_model(1.0)),
        (moving_model(0.0), moving_model(-0.0)),
        (moving_model(q_of), moving_model(lambda p: p["q"])),
        (moving_model(lambda p: p["q"]), moving_model(lambda p: p["q"])),
        (moving_model(np.float32(1)), moving_model(np.float64(1))),
        (counted_model((1.0, 0.0)), counted_model((0.0, 1.0))),
        (ej.kalman(moving_model()), ej.extended(moving_model())),
        (ej.kalman(moving_model()), tuple(ej.kalman(moving_model()))),
        (ej.transforms.positive(), ej.transforms.psd()),
        (BY_HAND["estimator"](), ej.Estimator(halved, halved, halved, halved)),
    ],
)
def test_different_things_differ(one, other):
    assert one != other
    assert operator.eq(one, other) is False


def test_large_arrays_are_compared_by_content():
    table = np.ones((100, 1, 2))
    one = ej.linear_model(F, table, np.eye(1))
    same, by_jax = (
        ej.linear_model(F, table.copy(), np.eye(1)),
        ej.linear_model(F, jnp.asarray(table), np.eye(1)),
    )
    table[99, 0, 1] = 2  # the model has its own
    assert one == same == by_jax
    assert one != ej.linear_model(F, table, np.eye(1))
    assert float(one.linear.H(None, jnp.asarray(99), 0.0)[0, 1]) == 1


def test_lambdas_travel_with_cloudpickle_and_filter_alike():
    model = moving_model(lambda p: p["q"])
    stream = ej.stream(np.arange(3.0), np.ones((3, 1)))
    setting = {"prior": ej.Gaussian(np.zeros(2), np.eye(2)), "t0": 0.0}
    filtered = ej.run(ej.kalman(model), {"q": 1.0}, stream, **setting)
    back = cloudpickle.loads(cloudpickle.dumps(ej.kalman(model)))
    again = ej.run(back, {"q": 1.0}, stream, **setting)
    np.testing.assert_array_equal(filtered.mean, again.mean)


def test_the_dtype_of_constants_is_part_of_a_thing():
    with jax.enable_x64(False):
        single = counted_model()
    assert single != counted_model()


def test_a_traced_argument_makes_a_thing_its_own():
    def of_q(q):
        one, other = ej.kalman(moving_model(q)), ej.kalman(moving_model(q))
        assert one == one
        assert one != other
        assert hash(one) != hash(other)
        stream = ej.stream(np.arange(3.0), np.ones((3, 1)))
        prior = ej.Gaussian(np.zeros(2), np.eye(2))
        return ej.run(one, None, stream, prior=prior, t0=0.0).mean[-1, 0]

    slope = jax.grad(of_q)(1.0)
    step = 1e-6
    expected = (of_q_known(1 + step) - of_q_known(1 - step)) / (2 * step)
    np.testing.assert_allclose(slope, expected, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.grad(of_q))(2.0), jax.grad(of_q)(2.0), rtol=1e-9)


def of_q_known(q):
    stream = ej.stream(np.arange(3.0), np.ones((3, 1)))
    model = moving_model(lambda p: p)
    prior = ej.Gaussian(np.zeros(2), np.eye(2))
    return ej.run(ej.kalman(model), q, stream, prior=prior, t0=0.0).mean[-1, 0]


@pytest.mark.parametrize("entry", ["run", "run_batch", "likelihood_loss", "jit"])
def test_a_filter_made_again_is_not_compiled_again(entry):
    stream = ej.stream(np.arange(3.0), np.ones((3, 1)))
    setting = {"prior": ej.Gaussian(np.zeros(2), np.eye(2)), "t0": 0.0}

    static = jax.jit(lambda est, x: est.predict(None, x, 1.0), static_argnums=0)

    def call():
        estimator = ej.kalman(counted_model())
        if entry == "run":
            return ej.run(estimator, None, stream, **setting)
        if entry == "likelihood_loss":
            return ej.likelihood_loss(estimator, stream, **setting)({"unused": 1.0})
        if entry == "jit":
            return static(estimator, estimator.init(None, setting["prior"], jnp.asarray(0.0)))
        batch = stream._replace(value=jnp.asarray(stream.value)[None])
        return ej.run_batch(estimator, None, batch, **setting)

    call()
    before = TRACES["F"]
    assert before > 0
    call()
    assert TRACES["F"] == before


def test_a_scenario_made_again_is_not_compiled_again():
    keys = jax.random.split(jax.random.key(0), 3)
    first = ej.simulate_batch(ej.scenarios.sine(), keys)
    before = _simulate_runs._cache_size()
    again = ej.simulate_batch(ej.scenarios.sine(), keys)
    assert _simulate_runs._cache_size() == before
    np.testing.assert_array_equal(first.truth, again.truth)


def test_repr_is_the_call_in_short():
    assert repr(ej.kalman(moving_model())) == "kalman(constant_velocity(...))"
    assert repr(ej.ewif(counted_model(), tau=2.0)) == "ewif(linear_model(...), tau=2.0)"
    assert repr(counted_model()) == "linear_model(F, float64[1, 2], float64[1, 1])"
    assert repr(ej.transforms.positive()) == "positive()"


def test_a_wrong_call_is_named_by_the_builder():
    with pytest.raises(TypeError, match=r"kalman\(\) missing 1 required positional argument"):
        ej.kalman()


def test_asking_for_the_hash_again_is_quick():
    estimator = ej.kalman(ej.linear_model(F, np.ones((1000, 1, 2)), np.eye(1)))
    hash(estimator)
    took = repeat(lambda: hash(estimator), number=100, repeat=20, timer=process_time)
    assert min(took) / 100 < 5e-6
