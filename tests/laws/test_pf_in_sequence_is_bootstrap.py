"""Without late data the particle filters for late data are the bootstrap filter, draw by draw."""

import jax
import numpy as np
import pytest
from late_streams import problem, stream

import ewif_jax as ej
from ewif_jax.estimators.bootstrap import bootstrap
from ewif_jax.oosm.pf_extended import pf_extended
from ewif_jax.oosm.pf_fixed_point import pf_fixed_point
from ewif_jax.oosm.pf_retrodict import pf_retrodict

GIVEN = problem(3, 2)
DATA = stream(GIVEN, np.random.default_rng(0), [0.5, 1.0, 1.0, 2.0, 2.5])


def shown(method):
    return ej.run(method, None, DATA, prior=GIVEN.prior, t0=0.0, key=jax.random.key(0))


@pytest.mark.parametrize(
    "method",
    [
        pf_retrodict(GIVEN.model, 100),
        pf_extended(GIVEN.model, 100, 2),
        pf_fixed_point(GIVEN.model, 100, 2),
    ],
    ids=["retrodict", "extended", "fixed point"],
)
def test_in_sequence_and_at_delay_zero_it_is_bootstrap(method):
    found, expected = shown(method), shown(bootstrap(GIVEN.model, 100))
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.cov, expected.cov, rtol=1e-9, atol=1e-12)
    for a, b in zip(found.info, expected.info, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
