"""Every loss has the gradient of its finite differences; `tune` goes downhill to the optimum."""

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


@pytest.mark.parametrize("name", ESTIMATORS)
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


@pytest.mark.parametrize("name", ESTIMATORS)
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
    """Least where q = 2 and the matrix is the given one."""
    wanted = jnp.asarray([[2.0, 0.5], [0.5, 1.0]])
    return jnp.log(p["q"] / 2) ** 2 + jnp.sum((p["R"] - wanted) ** 2)


def test_tune_finds_an_optimum_and_keeps_its_constraints():
    seen = []
    tuned = ej.tune(
        quadratic,
        {"q": 0.1, "R": np.eye(2)},
        steps=400,
        progress=lambda step, steps, loss: seen.append((step, steps, loss)),
    )
    np.testing.assert_allclose(tuned.params["q"], 2.0, rtol=1e-3)
    np.testing.assert_allclose(tuned.params["R"], [[2.0, 0.5], [0.5, 1.0]], atol=1e-3)
    assert tuned.loss < 1e-5
    assert [s[:2] for s in seen] == [(k + 1, 400) for k in range(400)]
    assert tuned.history["loss"].shape == (400,)
    assert np.all(tuned.history["params"]["q"] > 0)
    assert np.all(np.linalg.eigvalsh(tuned.history["params"]["R"]) > 0)


def test_a_loss_is_checked_once_and_compiled_once():
    traces = []

    def loss(p):
        traces.append(1)
        return (p["x"] - 1.0) ** 2

    ej.tune(loss, {"x": 3.0}, steps=5)
    assert len(traces) == 2


def test_an_infinite_gradient_leaves_the_parameters():
    def loss(p):
        return jnp.where(p["x"] < 2.5, jnp.inf * p["x"], (p["x"] - 1.0) ** 2)

    tuned = ej.tune(
        loss, {"x": 3.0}, steps=50, optimizer=optax.sgd(0.1), transforms=ej.unconstrained()
    )
    assert np.isfinite(tuned.params["x"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "steps: expected a whole number >= 1, got 0"),
        ({"params": {"x": -1.0}, "transforms": {"x": ej.positive()}}, "params.*hold"),
        ({"loss": lambda p: p["x"] * jnp.nan}, "loss: expected a finite number"),
    ],
)
def test_misuse_is_refused(change, message):
    arguments = {"loss": lambda p: p["x"] ** 2, "params": {"x": 1.0}, "steps": 3} | change
    with pytest.raises(ValueError, match=message):
        ej.tune(arguments.pop("loss"), arguments.pop("params"), **arguments)
