"""`lab.compare`: methods on the same runs, over a grid of numbers."""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from lab.world import EWIF, KEY, METRICS, MODEL, OVER, PRIOR, STEPS, WORLD, methods, simulate

lab = ej.lab
RUNS = 30


@pytest.fixture(scope="module")
def found():
    return lab.compare(
        methods(), WORLD, over=OVER, runs=RUNS, chunk=15, key=KEY, metrics=METRICS, time=True
    )


def test_it_is_monte_carlo_at_each_point(found):
    for point, name in ((0, "drop"), (5, "Al1")):
        numbers = found.points[point]
        here = ej.Scenario(simulate, PRIOR, 0.0, params=numbers)
        params = {"q": numbers["q"]}
        alone = ej.monte_carlo(
            methods()[name].estimator, params, here, runs=RUNS, key=KEY, metrics=METRICS
        )
        own = found.dataset["position"].sel({**numbers, "method": name})
        np.testing.assert_allclose(own, alone.per_run["position"], rtol=1e-12)
        over_time = found.dataset["position_over_time"].sel({**numbers, "method": name})
        np.testing.assert_allclose(over_time, alone.per_step["position"], rtol=1e-12)
        errors = found.dataset["position_over_time_se"].sel({**numbers, "method": name})
        np.testing.assert_allclose(errors, alone.per_step_se["position"], rtol=1e-9)


def test_the_table_says_means_errors_and_paired_differences(found):
    table = found.table(reference="drop", details=True).set_index(["delay", "q", "method"])
    squares = found.dataset["position"]
    for (delay, q, method), row in table.iterrows():
        own, other = (
            squares.sel({"delay": delay, "q": q, "method": m}).to_numpy() for m in (method, "drop")
        )
        assert row["value"] == pytest.approx(np.sqrt(own.mean()), rel=1e-12)
        error = own.std(ddof=1) / np.sqrt(RUNS) / (2 * row["value"])
        assert row["error"] == pytest.approx(error, rel=1e-10)
        assert row["difference"] == pytest.approx(
            np.sqrt(own.mean()) - np.sqrt(other.mean()), abs=1e-12
        )
        slopes = own / (2 * np.sqrt(own.mean())) - other / (2 * np.sqrt(other.mean()))
        paired = slopes.std(ddof=1) / np.sqrt(RUNS)
        assert row["difference_error"] == pytest.approx(paired, rel=1e-8, abs=1e-12)
    assert set(table["rank"]) == {1, 2, 3}
    late = table.xs(2.6, level="delay")
    assert (late.loc[(1.0, "Al1"), "difference"]) < 0
    assert table["too_late"].xs("drop", level="method").max() > 0


def test_other_methods_chunks_and_workers_do_not_show(found):
    some = {"drop": methods()["drop"]}
    setting = {"over": OVER, "runs": RUNS, "key": KEY, "metrics": METRICS}
    alone = lab.compare(some, WORLD, chunk=15, **setting)
    same = found.dataset["position"].sel({"method": "drop"}).to_numpy()
    np.testing.assert_array_equal(alone.dataset["position"].sel({"method": "drop"}), same)
    with ThreadPoolExecutor(2) as threads:
        spread = lab.compare(some, WORLD, chunk=15, executor=threads, **setting)
    np.testing.assert_array_equal(spread.dataset["position"].sel({"method": "drop"}), same)
    other = lab.compare(some, WORLD, chunk=20, **setting)  # the last one is half full
    np.testing.assert_allclose(
        other.dataset["position"].sel({"method": "drop"}), same, rtol=1e-12, atol=1e-15
    )
    np.testing.assert_array_equal(
        other.status_shares(3)["late_used"], alone.status_shares(3)["late_used"]
    )


def test_numbers_compile_nothing_again(found):
    programs = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: programs.append(event) if "backend_compile" in event else None
    )
    more = {"delay": [0.3, 1.1], "q": [0.2, 0.7]}
    lab.compare(
        methods(), WORLD, over=more, runs=RUNS, chunk=15, key=KEY, metrics=METRICS, time=True
    )
    assert programs == []


def test_every_method_is_scored_in_every_row(found):
    table = found.table().set_index(["delay", "q", "method"])
    assert (table["missing"] == 0).all()
    assert table["without"].max() == 0  # one measurement tells the EWIF all

    still = ej.models.constant_velocity(dims=1, q=1.0, sensors=ej.models.position_sensor(1.0))
    prior = ej.Gaussian(np.array([0.0, 0.0]), np.diag([4.0, 9.0]))
    world = ej.Scenario(lambda key: simulate(key, {"q": 0.5, "delay": 0.0}), prior, 0.0)
    lines = {
        "KF": ej.kalman(still),
        "EWIF": lab.Method(ej.ewif(still, tau=3.0), prior=None),
    }
    both = lab.compare(lines, world, runs=8, key=KEY, time=True)
    rows = both.table().set_index("method")
    assert rows.loc["EWIF", "without"] == 1  # the velocity takes two measurements
    assert (rows["missing"] == 0).all()
    # In the first row the prior, which is all that is known, stands in.
    truth = np.stack([world.simulate(jax.random.fold_in(KEY, i)).truth[0, 0] for i in range(8)])
    first = both.dataset["squared_error_over_time"].sel({"method": "EWIF"})[0]
    np.testing.assert_allclose(first, np.mean(truth**2), rtol=1e-12)

    nobody = lab.compare(lines | {"KF": lab.Method(ej.kalman(still), prior=prior)},
                         world._replace(prior=None), runs=8, key=KEY)  # fmt: skip
    assert nobody.table()["without"].max() == 0
    later = lab.compare(lines, world, runs=8, key=KEY, warm_up=2.0)
    np.testing.assert_allclose(
        later.dataset["squared_error"], nobody.dataset["squared_error"], rtol=1e-12
    )


def test_runs_are_added_until_errors_are_small():
    some = {"drop": methods()["drop"]}
    found = lab.compare(
        some, WORLD, over={"q": [0.1]}, runs="until 5 %", chunk=20, key=KEY, most_runs=2000
    )
    row = found.table().iloc[0]
    assert row["error"] <= 0.05 * row["value"]
    assert found.runs[0] % 20 == 0
    fewer = lab.compare(
        some, WORLD, over={"q": [0.1]}, runs=found.runs[0] - 20, chunk=20, key=KEY
    ).table().iloc[0]  # fmt: skip
    assert fewer["error"] > 0.05 * fewer["value"]


def test_limits_say_when_runs_converge_and_which_are_lost(found):
    limits = {"position": lab.Limits(converged=9.0, lost=1.0)}
    some = {"drop": methods()["drop"]}
    over = {"delay": [0.0], "q": [0.1]}
    judged = lab.compare(
        some, WORLD, over=over, runs=RUNS, chunk=15, key=KEY, metrics=METRICS, limits=limits
    )
    row = judged.table().iloc[0]
    last = judged.dataset["position_final"].to_numpy().ravel()
    assert row["lost"] == pytest.approx(np.mean(last > 1.0))
    np.testing.assert_array_equal(judged.dataset["position_lost"].to_numpy().ravel(), last > 1.0)
    scores = []
    for i in range(RUNS):
        one = simulate(jax.random.fold_in(KEY, i), {"q": 0.1, "delay": 0.0})
        trace = ej.run(ej.kalman(MODEL), {"q": 0.1}, one.measurements, prior=PRIOR, t0=0.0)
        scores.append(np.asarray(jnp.square(trace.mean - one.truth))[:, 0])
    bad = np.stack(scores) > 9.0
    since = np.where(bad.any(1), STEPS - np.argmax(bad[:, ::-1], 1) + 1.0, 1.0)
    since = np.where(since > STEPS, np.inf, since)
    np.testing.assert_array_equal(judged.dataset["position_converged"].to_numpy().ravel(), since)


def test_a_method_is_tuned_on_runs_of_its_own():
    tuned = lab.Method(
        EWIF, {"tau": 0.3}, prior=None,
        tune=lab.Tuning(runs=4, steps=5),
    )  # fmt: skip
    fixed = lab.Method(EWIF, {"tau": 0.3}, prior=None)
    found = lab.compare({"tuned": tuned, "fixed": fixed}, WORLD, runs=4, key=KEY)
    (row,) = found.tuned.to_dict("records")
    assert row["method"] == "tuned"
    assert row["tau"] != 0.3
    other = lab.compare(
        {"fixed": fixed._replace(params={"tau": row["tau"]})}, WORLD, runs=4, key=KEY
    )
    np.testing.assert_array_equal(
        found.dataset["squared_error"].sel({"method": "tuned"}),
        other.dataset["squared_error"].sel({"method": "fixed"}),
    )


def test_a_builder_of_scenarios_is_a_world_with_parameters():
    build = ej.scenarios.random_walk
    world = lab.parametric(build, steps=6, r=2.0)
    assert hash(world.simulate) == hash(lab.parametric(build, steps=6, r=2.0).simulate)
    assert world == lab.parametric(build, steps=6, r=2.0)
    assert world != lab.parametric(build, steps=6, r=3.0)
    own = world.simulate(KEY, {"mean_delay": 2.0, "of the methods": 1.0})
    other = build(steps=6, r=2.0, mean_delay=2.0).simulate(KEY)
    np.testing.assert_allclose(own.measurements.time, other.measurements.time, rtol=1e-12)
    np.testing.assert_allclose(own.truth, other.truth, rtol=1e-12)
    with pytest.raises(ValueError, match="fixed: expected arguments among q, r"):
        lab.parametric(build, lag=3)

    def moved(start=0.0):
        prior = PRIOR._replace(mean=jnp.reshape(start, (1,)))
        return ej.Scenario(lambda key: simulate(key, {"q": 0.5, "delay": start}), prior, 0.0)

    some = {"EWIF": methods()["EWIF"]}
    with pytest.raises(ValueError, match=r"over\['start'\].*neither the prior nor t0"):
        lab.compare(some, lab.parametric(moved), over={"start": [1.0]}, key=KEY)


REFUSED = {
    "an axis that nobody uses": ({"over": {"speed": [1.0]}}, r"over\['speed'\].*nobody uses"),
    "an axis that is no number": ({"over": {"delay": ["a"]}}, r"over\['delay'\]: expected a list"),
    "a number twice": ({"over": {"delay": [1.0, 1.0]}}, r"over\['delay'\].*different"),
    "no key": ({"key": None}, "key: expected a PRNG key"),
    "no runs": ({"runs": 1}, "runs: expected a whole number >= 2"),
    "other words": ({"runs": "many"}, "until 1 %"),
    "no methods": ({"methods": {}}, "methods: expected methods by name"),
    "no method": ({"methods": {"a": 3}}, r"methods\['a'\]: expected an Estimator"),
    "an axis that is not there": (
        {"methods": {"a": lab.Method(ej.kalman(MODEL), {"q": lab.axis("r")})}},
        r"methods\['a'\].params: expected an axis of over \(there is none\), got r",
    ),
    "no prior": (
        {"methods": {"a": lab.Method(ej.kalman(MODEL), {"q": 1.0}, prior=None)}},
        r"methods\['a'\]: prior: expected a Gaussian",
    ),
    "a parameter that is missing": (
        {"scenario": ej.Scenario(simulate, PRIOR, 0.0), "over": {"q": [1.0]}},
        "without 'delay'",
    ),
    "no score": ({"metrics": {"a": 3}}, r"metrics\['a'\]: expected a score"),
    "limits of nothing": ({"limits": {"b": lab.Limits()}}, "limits: expected one of the metrics"),
    "a fork": ({"executor": "fork"}, "executor: expected processes that do not fork"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED)
def test_misuse_is_refused(case):
    change, message = case
    if change.get("executor") == "fork":
        import multiprocessing
        from concurrent.futures import ProcessPoolExecutor

        context = multiprocessing.get_context("fork")
        change = {"executor": ProcessPoolExecutor(1, mp_context=context)}
    given = {"methods": {"a": methods()["EWIF"]}, "scenario": WORLD, "runs": 4, "key": KEY} | change
    with pytest.raises(ValueError, match=message):
        lab.compare(given.pop("methods"), given.pop("scenario"), **given)
