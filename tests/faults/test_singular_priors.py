"""A covariance whose smallest eigenvalue is above 0 by rounding alone has no inverse: refused."""

import numpy as np
import pytest

import ewif_jax as ej

TURN = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
MODEL = ej.linear_model(np.eye(3), np.eye(1, 3), np.eye(1))
TIME = np.arange(1.0, 6.0)


def cov_of(eigenvalues, dtype, scale=(1.0, 1.0, 1.0)):
    """(3, 3) with these eigenvalues, of states in other units."""
    cov = (TURN * np.asarray(eigenvalues)) @ TURN.T * np.outer(scale, scale)
    return ((cov + cov.T) / 2).astype(dtype)


def weight(params, t_l, t_k):
    return 1.0


FORMS = {
    "information": lambda s, p: ej.run(ej.information(MODEL), None, s, prior=p, t0=0.0).mean,
    "ewif": lambda s, p: ej.run(ej.ewif(MODEL, 2.0), None, s, prior=p, t0=0.0).mean,
    "two_sided": lambda s, p: ej.two_sided_ewif(MODEL, None, s, tau=2.0, prior=p, t0=0.0).mean,
    "wls": lambda s, p: ej.batch_wls(MODEL, None, s, TIME, weight=weight, prior=p, t0=0.0).mean,
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", FORMS)
def test_refused_where_it_would_be_inverted(name, dtype):
    stream = ej.stream(TIME, np.ones(5, dtype))
    eps = float(np.finfo(dtype).eps)
    for smallest in (0.0, 0.3 * eps, -0.3 * eps):
        prior = ej.Gaussian(np.zeros(3, dtype), cov_of([2.0, 1.0, smallest], dtype))
        with pytest.raises(ValueError, match=r"prior\.cov: expected a positive definite"):
            FORMS[name](stream, prior)


def test_other_units_do_not_make_it_singular():
    prior = ej.Gaussian(np.zeros(3), cov_of([2.0, 1.0, 0.5], np.float64, (1e-9, 1.0, 1e9)))
    found = FORMS["information"](ej.stream(TIME, np.ones(5)), prior)
    assert np.isfinite(found).all()


def test_every_run_is_looked_at():
    covs = np.stack([np.eye(3), cov_of([2.0, 1.0, 1e-17], np.float64), np.eye(3)])
    stream = ej.stream(TIME, np.ones(5))
    batch = stream._replace(value=np.ones((3, 5, 1)))
    prior = ej.Gaussian(np.zeros(3), covs)
    with pytest.raises(ValueError, match=r"prior\.cov: expected a positive definite"):
        ej.run_batch(ej.information(MODEL), None, batch, prior=prior, t0=0.0)
