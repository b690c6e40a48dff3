"""Every loss has the gradient of its finite differences; `tune` goes downhill to the optimum."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import ewif_jax as ej
from ewif_jax.tuning import value_and_gradient

PRIOR = ej.Gaussian(np.zeros(2), np.diag([4.0, 1.0]))
MODEL = ej.models.constant_velocity(
    sensors=[ej.models.position_sensor(lambda p: p["r"]), ej.models.position_sensor(2.0)],
    q=lambda p: p["q"],
)
PARAMS = {"tau": 1.7, "q": 0.4, "r": 0.8}


def late_and_masked(dtype=np.float64) -> tuple[ej.Measurement, np.ndarray]:
    """Three runs of ten arrivals: irregular, some late by run, some missing; and the truth."""
    rng = np.random.default_rng(11)
    time = np.cumsum(rng.uniform(0.2, 1.0, (3, 10)), 1)
    late = time - np.where(rng.uniform(size=(3, 10)) < 0.3, 0.9, 0.0)
    late = np.maximum(late, 0.05)
    value = np.sin(late)[..., None] + rng.normal(size=(3, 10, 1))
    mask = rng.uniform(size=(3, 10, 1)) > 0.2
    truth = np.sin(np.maximum.accumulate(late, 1))[..., None]
    stream = ej.Measurement(late.astype(dtype), value.astype(dtype), rng.integers(0, 2, 10), mask)
    return stream, truth.astype(dtype)


def losses(estimator: ej.Estimator, dtype=np.float64) -> dict:
    stream, truth = late_and_masked(dtype)
    setting = {"prior": PRIOR, "t0": 0.0}
    return {
        "rmse": ej.rmse_loss(estimator, stream, truth, **setting),
        "likelihood": ej.likelihood_loss(estimator, stream, **setting),
        "prediction": ej.prediction_loss(estimator, stream, **setting),
        "robust": ej.prediction_loss(estimator, stream, robust=True, **setting),
        "nees": ej.nees_loss(estimator, stream, truth, **setting),
        "nis": ej.nis_loss(estimator, stream, **setting),
    }


ESTIMATORS = {
    "ewif": (ej.ewif(MODEL, lambda p: p["tau"]), ("tau", "r")),
    "al1": (ej.al1(MODEL, 4), ("q", "r")),
}


EWIF_OR_ALL = ["ewif", pytest.param("al1", marks=pytest.mark.slow)]


@pytest.mark.parametrize("name", EWIF_OR_ALL)
def test_gradients_of_all_losses_are_finite_differences(name):
    estimator, names = ESTIMATORS[name]
    every = losses(estimator)

    def at(x):
        return PARAMS | dict(zip(names, x, strict=True))

    @jax.jit
    def all_losses(x):
        return jnp.stack([loss(at(x)) for loss in every.values()])

    @jax.jit
    def both_modes(x):
        def of(loss):
            _, push = jax.linearize(lambda x: loss(at(x)), x)
            return jax.vmap(push)(jnp.eye(x.size)), jax.linear_transpose(push, x)(jnp.ones(()))[0]

        return tuple(map(jnp.stack, zip(*map(of, every.values()), strict=True)))

    x = jnp.asarray([PARAMS[n] for n in names])
    forward, reverse = both_modes(x)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8, atol=1e-10)
    h = 1e-6
    for i in range(len(names)):
        step = h * np.eye(len(names))[i]
        wanted = (all_losses(x + step) - all_losses(x - step)) / (2 * h)
        np.testing.assert_allclose(forward[:, i], wanted, rtol=2e-6, atol=1e-8)
    assert np.all(np.abs(forward) > 1e-6), "a loss that does not depend on its parameters"


@pytest.mark.parametrize("name", EWIF_OR_ALL)
def test_gradients_are_finite_in_float32(name):
    estimator, names = ESTIMATORS[name]
    every = losses(estimator, np.float32)

    def all_losses(x):
        params = PARAMS | dict(zip(names, x, strict=True))
        return jnp.stack([loss(params) for loss in every.values()])

    x = jnp.asarray([PARAMS[n] for n in names], jnp.float32)
    gradient = jax.jit(jax.jacfwd(all_losses))(x)
    assert gradient.dtype == jnp.float32
    assert np.all(np.isfinite(gradient))


def test_few_numbers_and_many_have_the_same_gradient():
    def loss(p):
        return jnp.sum(jnp.cos(p["a"]) * p["b"] ** 2)

    few = {"a": jnp.arange(2.0), "b": jnp.asarray(1.5)}
    many = {"a": jnp.arange(7.0), "b": jnp.asarray(1.5)}
    for params in (few, many):
        value, gradient = value_and_gradient(loss, params)
        wanted = jax.grad(loss)(params)
        np.testing.assert_allclose(value, loss(params), rtol=1e-12)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), gradient, wanted)


def quadratic(p):
    """Least where q = 2 and the matrix is the given one; nowhere a number for q <= 0."""
    wanted = jnp.asarray([[2.0, 0.5], [0.5, 1.0]])
    return jnp.log(p["q"] / 2) ** 2 + jnp.sum((p["R"] - wanted) ** 2)


START = {"q": 0.1, "R": np.eye(2)}
METHODS = {
    "quasi-newton": {},
    "lbfgs": {"method": "lbfgs"},
    "adam": {"method": "adam", "steps": 400},
    "optax lbfgs": {"optimizer": optax.lbfgs()},
    "polyak": {"optimizer": optax.polyak_sgd(max_learning_rate=0.3)},
    "plateau": {
        "optimizer": optax.chain(optax.adam(0.1), optax.contrib.reduce_on_plateau(patience=30))
    },
}


@pytest.mark.parametrize("options", METHODS.values(), ids=METHODS)
def test_every_method_finds_the_optimum_and_returns_the_best_it_has_seen(options):
    seen = []
    tuned = ej.tune(
        quadratic, START, progress=lambda k, steps, loss: seen.append((k, loss)), **options
    )
    np.testing.assert_allclose(tuned.params["q"], 2.0, rtol=0.02)
    np.testing.assert_allclose(tuned.params["R"], [[2.0, 0.5], [0.5, 1.0]], atol=0.02)
    losses = tuned.history["loss"]
    assert tuned.loss == losses.min()
    assert [s[1] for s in seen] == list(losses[: len(seen)])
    assert seen[-1][0] == len(losses)
    assert tuned.history["params"]["R"].shape == (len(losses), 2, 2)
    assert np.all(tuned.history["params"]["q"] > 0)
    assert tuned.transforms == {"q": "positive()", "R": "unconstrained()"}
    assert tuned.reason.startswith(("converged", "out of steps"))
    assert "q" in repr(tuned)
    assert tuned.reason in repr(tuned)


def test_a_second_call_traces_nothing_and_looks_at_the_start_only():
    traces = []

    def loss(p):
        traces.append(isinstance(p["x"], jax.core.Tracer))
        return (p["x"] - 1.0) ** 2

    first = ej.tune(loss, {"x": 3.0}).params["x"]
    assert traces.count(True) == 1
    again = ej.tune(loss, {"x": 7.0}).params["x"]
    np.testing.assert_allclose([first, again], 1.0, atol=1e-6)
    assert traces.count(True) == 1
    ej.tune(loss, {"x": 3.0}, optimizer=optax.sgd(0.1), steps=5)
    assert traces.count(True) == 1


def test_many_starts_are_those_starts_one_by_one():
    starts = {"q": np.array([0.1, 1e-3, 50.0]), "R": np.stack([np.eye(2)] * 3)}
    together = ej.tune(quadratic, START, starts=starts)
    assert len(together.starts) == 3
    assert together.loss == min(t.loss for t in together.starts)
    for k, found in enumerate(together.starts):
        alone = ej.tune(quadratic, jax.tree.map(lambda x, k=k: x[k], starts))
        np.testing.assert_allclose(found.history["loss"], alone.history["loss"], rtol=1e-7)
        assert found.evaluations <= alone.evaluations
    listed = ej.tune(quadratic, START, starts=[START, START | {"q": 5.0}])
    assert [t.history["params"]["q"][0] for t in listed.starts] == pytest.approx([0.1, 5.0])
    spread = ej.tune(quadratic, START, starts=4, steps=2)
    first = [float(t.history["params"]["q"][0]) for t in spread.starts]
    assert len({round(np.log10(x), 2) for x in first}) == 4


FIXED = {
    "a name": ("R", None),
    "names": (["R"], None),
    "a prefix": ({"q": False, "R": True}, None),
    "some names": ({"R": True}, None),
    "a value": ({"R": 3 * np.eye(2)}, 3 * np.eye(2)),
}


@pytest.mark.parametrize("name", FIXED)
def test_what_is_fixed_stays(name):
    fixed, value = FIXED[name]
    tuned = ej.tune(quadratic, START, fixed=fixed)
    np.testing.assert_array_equal(tuned.params["R"], np.eye(2) if value is None else value)
    np.testing.assert_allclose(tuned.params["q"], 2.0, rtol=1e-6)
    assert tuned.transforms["R"] == "fixed"


def test_a_penalty_makes_the_maximum_of_a_posterior():
    """Of ten values around an unknown mean, and a prior: in closed form."""
    values = np.random.default_rng(3).normal(2.0, 1.0, 10)
    tuned = ej.tune(
        lambda p: jnp.sum((p["mean"] - values) ** 2) / 2,
        {"mean": 0.0},
        penalty=lambda p: (p["mean"] + 1.0) ** 2 / (2 * 0.5),
    )
    wanted = (values.sum() - 1.0 / 0.5) / (10 + 1 / 0.5)
    np.testing.assert_allclose(tuned.params["mean"], wanted, rtol=1e-6)


def test_held_out_loss_stops_early_and_chooses():
    tuned = ej.tune(
        lambda p: jnp.sum((p["x"] - 3.0) ** 2),
        {"x": np.zeros(2)},
        validation=lambda p: jnp.sum((p["x"] - 1.0) ** 2),
        optimizer=optax.sgd(0.01),
        patience=5,
    )
    assert tuned.reason.startswith("validation")
    held_out = tuned.history["validation"]
    chosen = np.nanargmin(held_out)
    assert tuned.evaluations == chosen + 7  # one to find the domain
    np.testing.assert_allclose(tuned.params["x"], tuned.history["params"]["x"][chosen])
    np.testing.assert_allclose(tuned.params["x"], 1.0, atol=0.05)


def variance_of(p):
    """Of ten values of variance 1 + v: least at v = 0.5 if they scatter by 1.5."""
    total = 1 + jnp.where(p["v"] < 0, jnp.nan, p["v"])
    return jnp.log(total) + 1.5 / total


def of_no_use(p):
    return jnp.where(p["v"] < 0, jnp.inf, 1 + p["v"])


def below(p):
    return jnp.where(p["v"] > 0, jnp.inf, (p["v"] + 2.0) ** 2)


DOMAINS = {
    "a variance": (variance_of, 3.0, "positive()", 0.5),
    "a variance that starts at 0": (variance_of, 0.0, "positive()", 0.5),
    "a free number": (lambda p: (p["v"] + 2.0) ** 2, 3.0, "unconstrained()", -2.0),
    "a free number that starts at 0": (lambda p: (p["v"] + 2) ** 2, 0.0, "unconstrained()", -2.0),
    "a negative number": (below, -0.1, "negative()", -2.0),
    "a variance best at 0": (of_no_use, 0.0, "fixed", 0.0),
}


@pytest.mark.parametrize("name", DOMAINS)
@pytest.mark.parametrize("options", [{}, {"method": "adam", "steps": 600}], ids=["default", "adam"])
def test_the_domain_of_a_number_is_found(name, options):
    loss, start, transform, wanted = DOMAINS[name]
    if options and start == 0 and transform == "positive()":
        pytest.skip("Adam's steps of at most 0.1 do not go eight decades")
    tuned = ej.tune(loss, {"v": start}, **options)
    assert tuned.transforms == {"v": transform}
    np.testing.assert_allclose(tuned.params["v"], wanted, rtol=1e-3)
    if transform == "fixed":
        assert "v stays 0" in tuned.reason
    elif start == 0 and transform == "positive()":
        assert "v started at 0, moved to 1e-08" in tuned.reason
    if transform in ("positive()", "fixed"):
        assert np.all(tuned.history["params"]["v"] >= 0)


ENDS = {
    "inside": (variance_of, {}, "converged"),
    "towards 0": (lambda p: 1 + jnp.log1p(jnp.sqrt(p["v"])), {}, "at a bound: v .* down"),
    "at a bound": (
        lambda p: (p["v"] - 3) ** 2, {"transforms": ej.transforms.bounded(0.5, 2.0)},
        "at a bound: v .* up",
    ),
    "no steps left": (variance_of, {"steps": 2}, "out of steps: all 2"),
    "no gradient": (lambda p: jnp.sqrt(p["v"] - p["v"]) + p["v"], {}, "not finite"),
}  # fmt: skip


@pytest.mark.parametrize("name", ENDS)
def test_why_it_ended(name):
    loss, options, reason = ENDS[name]
    tuned = ej.tune(loss, {"v": 1.0}, **options)
    assert np.isfinite(tuned.loss)
    assert re.match(reason, tuned.reason), tuned.reason


def test_an_infinite_gradient_leaves_the_parameters():
    def loss(p):
        return jnp.where(p["x"] < 2.5, jnp.inf * p["x"], (p["x"] - 1.0) ** 2)

    for options in ({}, {"optimizer": optax.sgd(0.1), "steps": 50}):
        tuned = ej.tune(loss, {"x": 3.0}, transforms=ej.transforms.unconstrained(), **options)
        assert 2.5 <= tuned.params["x"] < 2.7
        assert "not finite" in tuned.reason


def test_the_maximum_of_a_likelihood_in_float32_and_float64():
    """From variances a million times too large and too small: what SciPy finds of a NumPy filter
    (q = 0.36582, r = 1.03488, loss 1.7571923)."""
    rng = np.random.default_rng(0)
    value = np.cumsum(rng.normal(size=60)) * 0.5 + rng.normal(size=60)
    model = ej.models.random_walk(
        sensors=ej.models.position_sensor(lambda p: p["r"]), q=lambda p: p["q"]
    )
    prior = ej.Gaussian(np.zeros(1), 100 * np.eye(1))
    for dtype, rtol in ((np.float64, 1e-3), (np.float32, 0.02)):
        stream = ej.stream(np.arange(60.0), value.astype(dtype))
        loss = ej.likelihood_loss(ej.kalman(model), stream, prior=prior, t0=0.0)
        starts = {"q": np.array([1e6, 1e-6, 1e-4], dtype), "r": np.array([1e6, 1.0, 1e-4], dtype)}
        for tuned in ej.tune(loss, {"q": dtype(1), "r": dtype(1)}, starts=starts).starts:
            assert tuned.params["q"].dtype == dtype
            np.testing.assert_allclose(tuned.loss, 1.7571923, rtol=1e-5)
            found = [float(tuned.params[k]) for k in ("q", "r")]
            np.testing.assert_allclose(found, [0.36582, 1.03488], rtol=rtol)
            assert tuned.evaluations < 67


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "steps: expected a whole number >= 1, got 0"),
        ({"params": {"x": -1.0}, "transforms": {"x": ej.transforms.positive()}}, "params.*hold"),
        ({"loss": lambda p: p["x"] * jnp.nan}, "loss: expected a finite number"),
        ({"loss": lambda p: p["x"] * jnp.ones(2)}, "loss: expected one number"),
        ({"method": "newton"}, "method: expected one of quasi-newton"),
        ({"method": "adam", "optimizer": optax.sgd(0.1)}, "optimizer: expected either"),
        ({"fixed": "y"}, "fixed: expected names of the parameters"),
        ({"fixed": "x"}, "fixed: expected at least one"),
        ({"transforms": {"y": ej.transforms.positive()}}, "transforms: expected names"),
        ({"starts": {"x": 1.0}}, "starts: expected a pytree like"),
    ],
)
def test_misuse_is_refused(change, message):
    arguments = {"loss": lambda p: p["x"] ** 2, "params": {"x": 1.0}, "steps": 3} | change
    with pytest.raises(ValueError, match=message):
        ej.tune(arguments.pop("loss"), arguments.pop("params"), **arguments)
