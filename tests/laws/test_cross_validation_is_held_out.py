"""Folds do not overlap, and a cross-validated loss is that of the rows held out with what the other
rows say: in closed form for a mean."""

import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

R, T = 6, 40
RNG = np.random.default_rng(1)
VALUE = RNG.normal(1.0, 1.0, (R, T)) + RNG.normal(size=(R, 1))
TIME = np.cumsum(RNG.uniform(0.5, 1.5, T))
PRESENT = RNG.uniform(size=(R, T)) > 0.2
BATCH = ej.Measurement(TIME, VALUE[..., None], np.zeros(T, np.int32), PRESENT[..., None])


def mean_loss(where):
    where = jnp.broadcast_to(jnp.asarray(where), (R, T))

    def loss(p):
        square = (jnp.asarray(VALUE) - p["mean"]) ** 2
        return jnp.sum(jnp.where(where, square, 0)) / jnp.sum(where)

    return loss


@pytest.mark.parametrize("kind", ["runs", "time"])
def test_a_held_out_loss_is_of_rows_that_were_not_seen(kind):
    folds = ej.run_folds(BATCH, 3) if kind == "runs" else ej.time_folds(BATCH, 4, gap=3.0)
    found = ej.cross_validated(mean_loss, folds, {"mean": 0.0})
    for k, (train, held_out) in enumerate(folds):
        train, held_out = (np.broadcast_to(x, (R, T)) for x in (train, held_out))
        mean = VALUE[train].mean()
        np.testing.assert_allclose(found.tuned[k].params["mean"], mean, rtol=1e-6)
        np.testing.assert_allclose(found.held_out[k], ((VALUE[held_out] - mean) ** 2).mean(), 1e-6)
        np.testing.assert_allclose(found.train[k], VALUE[train].var(), rtol=1e-6)
    np.testing.assert_allclose(found.mean, found.held_out.mean())
    np.testing.assert_allclose(found.error, found.held_out.std(ddof=1) / len(folds) ** 0.5)


def test_folds_cover_all_rows_once_and_keep_their_distance():
    for folds in (ej.run_folds(BATCH, 4), ej.time_folds(BATCH, 4, gap=2.0)):
        assert not any((train & held_out).any() for train, held_out in folds)
    in_time = ej.time_folds(BATCH, 4, gap=2.0)
    np.testing.assert_array_equal(sum(np.int32(f.held_out) for f in in_time), PRESENT)
    for train, held_out in in_time:
        mine, others = TIME[held_out.any(0)], TIME[train.any(0)]
        assert np.abs(mine[:, None] - others).min() >= 2.0
    np.testing.assert_array_equal(sum(np.int32(f.held_out) for f in ej.run_folds(BATCH, 4)), 1)


def test_a_filter_is_cross_validated_in_one_program():
    model = ej.models.random_walk(sensors=ej.models.position_sensor(1.0), q=lambda p: p["q"])
    prior, built = ej.Gaussian(np.zeros(1), 4 * np.eye(1)), []

    def build(where):
        built.append(where)
        return ej.likelihood_loss(ej.kalman(model), BATCH, prior=prior, t0=0.0, where=where)

    folds = ej.run_folds(BATCH, 3)
    found = ej.cross_validated(build, folds, {"q": 0.5})
    for k, fold in enumerate(folds):
        alone = build(fold.held_out)(found.tuned[k].params)
        np.testing.assert_allclose(found.held_out[k], alone, rtol=1e-9)
        assert found.tuned[k].params["q"] > 0
    assert found.tuned[0].transforms == {"q": "positive()"}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ej.run_folds(BATCH, 9), "folds: expected at most 6"),
        (lambda: ej.run_folds(BATCH, 1), "folds: expected a whole number >= 2"),
        (lambda: ej.time_folds(BATCH, 4, gap=100.0), "folds: expected rows in every block"),
        (lambda: ej.time_folds(BATCH, 4, gap=-1.0), "gap"),
        (lambda: ej.cross_validated(mean_loss, [], {"mean": 0.0}), "folds: expected at least one"),
    ],
)
def test_folds_that_are_none_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
