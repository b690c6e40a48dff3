"""The fast layout changes no number: `run_batch` is `vmap(run)`, with shared and per-run inputs."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

import ewif_jax as ej
from ewif_jax import scores as scores_of
from ewif_jax.fast import groups as grouping
from ewif_jax.fast import loops
from ewif_jax.scores import scored

RUNS, STEPS = 5, 12
SENSORS = [ej.models.position_sensor(r, dims=2) for r in (0.5, 2.0)]
MODEL = ej.models.constant_velocity(sensors=SENSORS, q=lambda p: p["q"], dims=2)
PRIOR = ej.Gaussian(np.zeros(4), np.eye(4))
ESTIMATORS = {
    "kalman": ej.kalman(MODEL),
    "ewif": ej.ewif(MODEL, lambda p: p["tau"]),
    "selective_al1": ej.selective(ej.al1(MODEL, lag=6), lambda p: p["cutoff"]),
}


def streams(shared: bool) -> ej.Measurement:
    rng = np.random.default_rng(3)
    time = np.arange(STEPS) + rng.uniform(-1.5, 1.5, (RUNS, STEPS)) + 2.0
    sensor = rng.integers(0, 2, (RUNS, STEPS))
    mask = rng.uniform(size=(RUNS, STEPS, 2)) > 0.2
    value = rng.normal(size=(RUNS, STEPS, 2))
    if shared:
        time, sensor, mask = time[0], sensor[0], mask[0]
    return ej.Measurement(time, value, sensor, mask)


@pytest.mark.parametrize("shared", [True, False], ids=["shared", "per_run"])
@pytest.mark.parametrize("name", ESTIMATORS)
def test_run_batch_is_vmap_of_run(name, shared):
    estimator, batch = ESTIMATORS[name], streams(shared)
    params = {
        "q": np.linspace(0.1, 2.0, RUNS),
        "tau": np.linspace(0.5, 4.0, RUNS),
        "cutoff": np.linspace(0.0, 3.0, RUNS),
    }
    if shared:
        params = {key: x[2] for key, x in params.items()}
    got = ej.run_batch(estimator, params, batch, prior=PRIOR, t0=0.0, params_per_run=not shared)
    one = 0 if not shared else None
    axes = (one, ej.Measurement(one, 0, one, one))
    wanted = jax.vmap(lambda p, m: ej.run(estimator, p, m, prior=PRIOR, t0=0.0), in_axes=axes)(
        params, batch
    )
    for field in ("time", "mean", "cov", "info"):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10),
            getattr(got, field),
            getattr(wanted, field),
        )
    assert jnp.all(jnp.isfinite(got.mean))


def regular(runs: int, steps: int, shared_time: bool = True) -> ej.Measurement:
    rng = np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.1, 1.0, (runs, steps)), 1)
    time = time[0] if shared_time else time
    sensor, mask = np.zeros(steps, int), np.ones((steps, 2), bool)
    return ej.Measurement(time, rng.normal(size=(runs, steps, 2)), sensor, mask)


@pytest.fixture(
    params=[(1, False), (16, False), (24, False), (24, True)],
    ids=["one_by_one", "dividing", "overlapping", "together"],
)
def groups(request, monkeypatch):
    size, together = request.param
    monkeypatch.setattr(loops, "group_size", lambda *_: size)
    monkeypatch.setattr(loops, "goes_together", lambda _: together)
    several_blocks = grouping.SIZES._replace(shown=1)  # also of short steps
    monkeypatch.setattr(grouping, "SIZES", several_blocks)
    return size


def worlds(steps, shared):
    """48 runs that share nothing, their times, or also the process noise."""
    measurements = regular(48, steps, shared_time=shared != "nothing")
    return {"q": 0.7 if shared == "all" else np.linspace(0.1, 2.0, 48)}, measurements


@cache
def alone(steps, shared):
    """Some of these runs, by `run`: the same whatever the groups."""
    params, measurements = worlds(steps, shared)

    def one(k):
        own = jax.tree.map(
            lambda x: x[k] if np.shape(x)[:1] == (48,) else x, (params, measurements)
        )
        return jax.device_get(ej.run(ej.kalman(MODEL), *own, prior=PRIOR, t0=0.0))

    return {k: one(k) for k in (0, 17, 23, 24, 40, 47)}


@pytest.mark.parametrize("shared", ["nothing", "time", "all"])
@pytest.mark.parametrize("steps", [7, 32], ids=["one_block", "blocks"])
def test_neither_groups_of_runs_nor_blocks_of_steps_show(steps, shared, groups):
    if groups == 1 and shared == "time":
        pytest.skip("one by one, nothing is computed ahead: what is shared is passed like the rest")
    params, measurements = worlds(steps, shared)
    estimator, start = ej.kalman(MODEL), {"prior": PRIOR, "t0": 0.0}
    start["params_per_run"] = shared != "all"
    got = jax.device_get(ej.run_batch(estimator, params, measurements, **start))
    for k, wanted in alone(steps, shared).items():
        jax.tree.map(
            lambda a, b, k=k: np.testing.assert_allclose(a[k], b, rtol=1e-10, atol=1e-12),
            got,
            wanted,
        )
    if steps == 32:  # in blocks, each with its part of the truth, which is of width 0
        scores = {"score": scores_of.squared_innovation}
        found = scored(estimator, params, measurements, scores=scores, **start)["score"]
        np.testing.assert_allclose(found, np.sum(got.info.innovation**2, -1), rtol=1e-10)


def in_batch(estimator, params, measurements):
    return ej.run_batch(estimator, params, measurements, prior=PRIOR, t0=0.0)


def one_by_one(estimator, params, measurements):
    axes = (ej.Measurement(None, 0, None, None),)
    return jax.vmap(lambda m: ej.run(estimator, params, m, prior=PRIOR, t0=0.0), in_axes=axes)(
        measurements
    )


def loss_of(measurements, filtered):
    """In the process noise and the values."""

    def loss(q, value):
        trace = filtered(ej.kalman(MODEL), {"q": q}, measurements._replace(value=value))
        return jnp.sum(trace.mean**2) + jnp.sum(trace.cov)

    return loss


@cache
def slopes_one_by_one(steps):
    """The same whatever the groups."""
    measurements = regular(40, steps)
    loss = loss_of(measurements, one_by_one)
    return jax.device_get(jax.jit(jax.value_and_grad(loss, (0, 1)))(0.7, measurements.value))


@pytest.mark.parametrize("steps", [7, 20], ids=["one_block", "blocks"])
def test_gradients_go_through_groups_of_runs(steps, groups):
    """In both modes, with the results of all groups in one array."""
    measurements = regular(40, steps)
    loss = loss_of(measurements, in_batch)

    @jax.jit
    def both_modes(*at):
        found, push = jax.linearize(loss, *at)
        reverse = jax.linear_transpose(push, *at)(jnp.ones(()))
        return found, reverse, push(jnp.ones(()), jnp.zeros_like(at[1]))

    wanted, (in_q, in_values) = slopes_one_by_one(steps)
    found, slopes, forward = both_modes(jnp.asarray(0.7), measurements.value)
    np.testing.assert_allclose(found, wanted, rtol=1e-10)
    np.testing.assert_allclose(slopes[0], in_q, rtol=1e-10)
    np.testing.assert_allclose(slopes[1], in_values, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(forward, in_q, rtol=1e-10)


def derivatives_in_q(filtered, q, per_run):
    """Reverse mode, forward mode, forward over reverse, and two directions in one pass."""
    measurements = regular(40, 20)

    def loss(q):
        trace = filtered({"q": q}, measurements, per_run)
        return jnp.sum(trace.mean**2) + jnp.sum(trace.cov) ** 2

    @jax.jit
    def all_of_them(q):
        ones, ramp = jnp.ones_like(q), jnp.linspace(-1.0, 2.0, q.size).reshape(q.shape)
        along = jax.jvp(lambda q: jax.jvp(loss, (q,), (ones,)), (q,), (ramp,))
        return along, jax.jvp(jax.grad(loss), (q,), (ramp,))

    return jax.device_get(all_of_them(jnp.asarray(q)))


def batch_in_q(params, measurements, per_run):
    start = {"prior": PRIOR, "t0": 0.0, "params_per_run": per_run}
    return ej.run_batch(ej.kalman(MODEL), params, measurements, **start)


def runs_in_q(params, measurements, per_run):
    axes = ({"q": 0 if per_run else None}, ej.Measurement(None, 0, None, None))
    alone = partial(ej.run, ej.kalman(MODEL), prior=PRIOR, t0=0.0)
    return jax.vmap(alone, in_axes=axes)(params, measurements)


@cache
def derivatives_one_by_one(per_run):
    return derivatives_in_q(runs_in_q, own_q(per_run), per_run)


def own_q(per_run):
    return np.linspace(0.2, 2.0, 40) if per_run else np.array(0.7)


@pytest.mark.parametrize("per_run", [False, True], ids=["shared", "per_run"])
def test_slopes_in_few_numbers_are_those_of_the_runs(per_run, groups):
    """Of every order and in both modes, although they are computed beside the values."""
    found = derivatives_in_q(batch_in_q, own_q(per_run), per_run)
    wanted = derivatives_one_by_one(per_run)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9), found, wanted)


def test_batches_can_be_mapped_over_parameters(groups):
    """Short steps are read from the whole, at a place that all have in common."""
    measurements, qs = regular(40, 20), np.array([0.2, 0.7])

    def means(q):
        return in_batch(ej.kalman(MODEL), {"q": q}, measurements).mean

    found = jax.jit(jax.vmap(means))(qs)
    wanted = one_by_one(ej.kalman(MODEL), {"q": qs[1]}, measurements).mean
    np.testing.assert_allclose(found[1], wanted, rtol=1e-10, atol=1e-12)


def test_reverse_mode_touches_the_whole_result_no_more_often_than_the_filter(groups):
    """Where a group clears or adds up its part of all runs, the time grows as their square."""
    measurements = regular(40, 20)
    loss = loss_of(measurements, in_batch)

    def wholes(fn):
        everywhere = equations(jax.make_jaxpr(fn)(0.7, measurements.value).jaxpr)
        inside = within_loops(everywhere)
        inside = [e for e in inside if e.primitive.name in ("dynamic_update_slice", "add_any")]
        return sum(len(v.aval.shape) > 1 and v.aval.shape[0] == 40 for v in outputs(inside))

    assert wholes(loss) > 0
    assert wholes(jax.grad(loss, (0, 1))) <= wholes(loss)


@pytest.mark.parametrize("name", ["kalman", "ensemble"])
def test_only_random_members_make_a_state_a_vector(name, monkeypatch):
    estimator = {"kalman": ej.kalman(MODEL), "ensemble": ej.ensemble(MODEL, 8)}[name]
    seen = []
    monkeypatch.setattr(loops, "group_size", lambda *sizes: seen.append(sizes) or 5)
    key = jax.random.key(0)  # `monte_carlo` passes one to every filter
    ej.run_batch(estimator, {"q": 0.7}, regular(5, 3), prior=PRIOR, t0=0.0, key=key)
    assert {draws for *_, draws in seen} == {name == "ensemble"}


@pytest.mark.parametrize(("per_run", "packed"), [(False, (10,)), (True, (10, 24))])
def test_covariances_that_all_share_are_computed_before_the_groups(per_run, packed, monkeypatch):
    monkeypatch.setattr(loops, "group_size", lambda *_: 24)

    def means(q):
        return ej.run_batch(
            ej.kalman(MODEL),
            {"q": q},
            regular(96, 20),
            prior=PRIOR,
            t0=0.0,
            params_per_run=per_run,
            observe=lambda step, _: step.mean,
        )

    q = np.full(96, 0.7) if per_run else np.float64(0.7)
    everywhere = list(equations(jax.make_jaxpr(means)(q).jaxpr))
    inside = within_loops(within_loops(everywhere, length=4), length=20)
    assert packed in shapes(everywhere)
    assert (packed in shapes(inside)) == per_run
    assert (4, 24) in shapes(inside)


@pytest.mark.parametrize("size", [24, 48], ids=["groups", "together"])
def test_what_a_model_prints_is_printed(size, monkeypatch):
    """Computed ahead or not, printing is no output of a step, and not to be lost."""
    monkeypatch.setattr(loops, "group_size", lambda *_: size)
    noted = []

    def q(params):
        jax.debug.callback(noted.append, params["q"])
        return params["q"]

    model = ej.models.constant_velocity(sensors=SENSORS, q=q, dims=2)
    trace = ej.run_batch(ej.kalman(model), {"q": 0.7}, regular(48, 7), prior=PRIOR, t0=0.0)
    jax.block_until_ready(trace)
    jax.effects_barrier()
    assert noted
    assert set(map(float, noted)) == {0.7}


def equations(jaxpr):
    """All of them, also of the loops and functions inside."""
    for eqn in jaxpr.eqns:
        yield eqn
        for inner in jaxprs_in_params(eqn.params):
            yield from equations(inner)


def within_loops(among, length=None):
    """The equations of all loops, or of those of a length."""
    found = [e for e in among if e.primitive.name == "scan"]
    found = [e for e in found if length in (None, e.params["length"])]
    return [inner for e in found for inner in equations(e.params["jaxpr"].jaxpr)]


def outputs(equations):
    return [v for eqn in equations for v in eqn.outvars]


def shapes(equations):
    return {v.aval.shape for v in outputs(equations)}


@pytest.mark.parametrize("runs", [5, 16, 17, 97, 1000, 1024, 10_000])
@pytest.mark.parametrize(("joined", "together"), [(True, True), (True, False), (False, False)])
def test_groups_are_no_larger_than_caches_and_waste_little(runs, joined, together, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(grouping, "loops_are_joined", lambda: joined)
    for own, shared, largest, itemsize in ((108, 4, 144, 4), (216, 8, 288, 8), (1000, 0, 700, 4)):
        size = grouping.group_size(runs, own, shared, largest, itemsize, together)
        assert min(runs, 64) <= size <= runs
        assert size * (own + shared) <= grouping.SIZES.second_cache
        assert size * largest <= grouping.SIZES.undivided
        assert -(-runs // size) * size <= 1.25 * runs
    assert grouping.group_size(runs, 10**6, 0, 10**6, 4) == 1
    assert grouping.group_size(runs, 20_008, 0, 16_000, 4, draws=True) == 1


def test_blocks_divide_the_steps():
    some = (7, 96, 97, 1000)
    assert [grouping.block_size(steps, 10**4, False) for steps in some] == [7, 16, 97, 20]
    assert [grouping.block_size(steps, 1920, True) for steps in some] == [7, 96, 97, 100]
    assert [grouping.block_size(steps, 10**5, True) for steps in some] == [7, 16, 97, 20]


def test_raw_and_typed_keys_are_split_over_the_runs():
    estimator = ej.ensemble(MODEL, 8)
    batch = ej.Measurement(
        np.arange(3.0), np.zeros((2, 3, 2)), np.zeros(3, int), np.ones((3, 2)) > 0
    )
    raw, typed = jax.random.PRNGKey(4), jax.random.key(4)
    a, b, c = (
        ej.run_batch(estimator, {"q": 1.0}, batch, prior=PRIOR, t0=0.0, key=key).mean
        for key in (raw, typed, jax.random.split(typed, 2))
    )
    np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(b, c)
    assert np.any(np.asarray(b[0]) != np.asarray(b[1]))
