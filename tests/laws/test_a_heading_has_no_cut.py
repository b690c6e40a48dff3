"""A state with an angle is estimated alike wherever on the circle it is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.models import angles, wrap_angle
from ewif_jax.recursions.ensembles import sample_moments
from ewif_jax.recursions.particles import weighted_moments
from laws.cases import close

TURN = 3.0
"""By how much everything is turned: the heading then lies on both sides of the cut."""
COMPASS = ej.models.sensor(lambda params, x, t: x[:1], 0.05, angle=True)


def turning(params, x, t0, t1):
    """A heading that is kept in (-pi, pi], and its rate, which slows down as it grows."""
    dt = t1 - t0
    return jnp.stack([wrap_angle(x[0] + dt * jnp.sin(x[1])), x[1]])


def change(params, t0, t1):
    kept = jnp.exp(-(t1 - t0) * jnp.array([0.1, 0.2]))
    return jnp.stack([jnp.stack([kept[0], 1 - kept[0]]), jnp.stack([1 - kept[1], kept[1]])])


def noise(params, t0, t1):
    dt = t1 - t0
    return params["q"] * jnp.asarray([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])


def model_of(state_angle: tuple[bool, ...] | None = (True, False)) -> ej.Model:
    bank = ej.models.constant_velocity(sensors=COMPASS)
    return ej.Model(
        turning, noise, bank.observe, bank.measurement_cov, bank.residual,
        sensors=1, state_angle=state_angle,
    )  # fmt: skip


MODEL, PARAMS = model_of(), {"q": 0.02}
TIMES = np.array([0.5, 1.0, 2.0, 1.5, 2.5])
VALUES = np.array([[0.2], [0.4], [-0.1], [0.3], [0.1]])
PRIOR = ej.Gaussian(np.array([0.1, 0.2]), np.diag([0.15, 0.1]))


def turned(by: float) -> tuple[ej.types.Measurement, ej.Gaussian]:
    """The problem with everything turned: values in (-pi, pi], as a compass gives them."""
    values = np.angle(np.exp(1j * (VALUES + by)))
    return ej.stream(TIMES, values), PRIOR._replace(mean=PRIOR.mean + np.array([by, 0.0]))


def same_direction(found, expected, tolerance=1e-9):
    apart = np.asarray(wrap_angle(jnp.asarray(found) - jnp.asarray(expected)))
    np.testing.assert_allclose(apart, 0, atol=tolerance)


METHODS = {
    "extended": ej.extended,
    "unscented": ej.unscented,
    "al1": lambda model: ej.al1(model, 4),
    "rts_reference": lambda model: ej.rts_reference(model, 4),
    "ensemble": lambda model: ej.ensemble(model, 12),
    "ensemble, square root": lambda model: ej.ensemble(model, 12, "square_root"),
    "enkf1": lambda model: ej.enkf1(model, 12, 4),
    "enkf2": lambda model: ej.enkf2(model, 12, 4),
    "bootstrap": lambda model: ej.bootstrap(model, 30),
    "guided": lambda model: ej.guided(model, 30),
    "imm": lambda model: ej.imm([ej.extended(model), ej.unscented(model)], change),
    "ewif, sigma points": lambda model: ej.ewif(model, 2.0, linearisation="sigma-points"),
    "pf_retrodict": lambda model: ej.pf_retrodict(model, 30),
    "pf_extended": lambda model: ej.pf_extended(model, 30, 4),
    "pf_fixed_point, eks": lambda model: ej.pf_fixed_point(model, 30, 4, "eks"),
    "pf_fixed_point, ps": lambda model: ej.pf_fixed_point(model, 30, 4, "ps"),
}
QUICK = ("unscented", "imm", "al1", "ensemble", "enkf1", "bootstrap", "pf_extended")
"""The others with --all."""


@pytest.mark.parametrize(
    "build",
    [
        pytest.param(b, id=n, marks=() if n in QUICK else pytest.mark.slow)
        for n, b in METHODS.items()
    ],
)
def test_a_turned_world_has_a_turned_estimate(build):
    traces = []
    for by in (0.0, TURN):
        stream, prior = turned(by)
        key = jax.random.key(2)
        traces.append(ej.run(build(MODEL), PARAMS, stream, prior=prior, t0=0.0, key=key))
    plain, other = traces
    assert (np.asarray(plain.info.status) < 2).sum() >= 4
    same_direction(other.mean[:, 0], plain.mean[:, 0] + TURN)
    close(other.mean[:, 1], plain.mean[:, 1])
    close(other.cov, plain.cov)
    close(other.info.innovation, plain.info.innovation)
    close(other.info.log_likelihood, plain.info.log_likelihood)


@pytest.mark.parametrize("form", ["extended", "unscented"])
def test_smoothers_are_turned_with_the_world(form):
    found, expected = (
        ej.rts(MODEL, PARAMS, stream, prior=prior, t0=0.0, form=form)
        for stream, prior in map(turned, (TURN, 0.0))
    )
    same_direction(found.mean[:, 0], expected.mean[:, 0] + TURN)
    close(found.mean[:, 1], expected.mean[:, 1])
    close(found.cov, expected.cov)


def test_without_being_told_sigma_points_have_a_cut():
    """What the law above is about, and so can fail."""
    stream, prior = turned(TURN)
    told, not_told = (
        ej.run(ej.unscented(m), PARAMS, stream, prior=prior, t0=0.0)
        for m in (MODEL, model_of(None))
    )
    assert np.abs(np.asarray(told.mean - not_told.mean))[-1, 1] > 0.3


def test_the_slope_is_the_same_in_a_turned_world():
    estimator = ej.ensemble(MODEL, 12)

    @jax.jit
    def total(q, stream, prior):
        found = ej.run(estimator, {"q": q}, stream, prior=prior, t0=0.0, key=jax.random.key(2))
        return jnp.sum(found.info.log_likelihood)

    given = turned(TURN)
    (low, high), slope = (total(0.02 + d, *given) for d in (-1e-6, 1e-6)), jax.grad(total)
    found, plain = slope(0.02, *given), slope(0.02, *turned(0.0))
    np.testing.assert_allclose(found, plain, rtol=1e-7)
    np.testing.assert_allclose(found, (high - low) / 2e-6, rtol=1e-5)


def test_single_precision_knows_no_cut_either():
    stream, prior = jax.tree.map(
        lambda x: np.asarray(x, np.float32) if np.asarray(x).dtype == float else x, turned(TURN)
    )
    short = ej.run(ej.unscented(MODEL), PARAMS, stream, prior=prior, t0=0.0)
    long = ej.run(ej.unscented(MODEL), PARAMS, turned(TURN)[0], prior=turned(TURN)[1], t0=0.0)
    assert short.mean.dtype == np.float32
    same_direction(short.mean[:, 0].astype(float), long.mean[:, 0], 1e-4)


def by_hand(x: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance about the circular mean of the first row."""
    centre = np.angle(weights @ np.exp(1j * x[0]))
    away = np.stack([np.angle(np.exp(1j * (x[0] - centre))), x[1]])
    mean = away @ weights
    cov = (away - mean[:, None]) * weights @ (away - mean[:, None]).T
    mean[0] = np.angle(np.exp(1j * (mean[0] + centre)))
    return mean, cov


def test_means_are_circular():
    rng = np.random.default_rng(0)
    turns = 2 * np.pi * rng.integers(-2, 3, 40)
    x = np.stack([np.pi + 0.5 * rng.normal(size=40) + turns, rng.normal(size=40)])
    weights = rng.uniform(size=40)
    weights /= weights.sum()
    angle = (True, False)
    mean, cov = jax.jit(weighted_moments, static_argnums=2)(x, weights, angle)
    close(mean, by_hand(x, weights)[0])
    close(cov, by_hand(x, weights)[1])
    mean, cov = jax.jit(sample_moments, static_argnums=1)(x, angle)
    equal = by_hand(x, np.full(40, 1 / 40))
    close(mean, equal[0])
    close(cov, equal[1] * 40 / 39)


def test_where_nothing_is_near_the_cut_it_is_the_plain_mean():
    x = np.random.default_rng(1).uniform(-0.5, 0.5, size=(2, 30))
    close(sample_moments(jnp.asarray(x), (True, False)).mean, x.mean(1), 1e-12)


def test_flags_of_another_size_are_refused():
    model = model_of((True,))
    stream, prior = turned(0.0)
    with pytest.raises(ValueError, match=r"state_angle: expected shape \(2,\), got shape \(1,\)"):
        ej.run(ej.unscented(model), PARAMS, stream, prior=prior, t0=0.0)


def test_a_linear_filter_may_be_more_than_a_turn_off():
    """Its states are numbers on a line: nothing is wrapped."""
    line = ej.models.constant_velocity(sensors=ej.models.position_sensor(1.0))
    line = line._replace(state_angle=(True, False))
    assert float(angles.state_difference(line, jnp.asarray([7.0, 0.0]), jnp.zeros(2))[0]) == 7.0
