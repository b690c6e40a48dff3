"""The methods that leave the process noise out of a late measurement, by finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

TIMES = np.array([0.4, 1.0, 0.7, 1.7, 2.0, 1.8, 2.5, 0.1])
VALUES = np.array([0.3, 0.9, 0.4, 1.8, 1.6, 2.2, 2.4, -0.2])
LATE = np.array([2, 5])
AT = jnp.array([0.3, 0.5])
PRIOR = ej.Gaussian(jnp.array([0.2, 0.8]), jnp.array([[1.0, 0.1], [0.1, 0.5]]))


@pytest.mark.parametrize("build", [ej.b1, lambda model: ej.bl1(model, 3)], ids=["b1", "bl1"])
def test_gradient_is_finite_and_the_finite_difference(build):
    model = ej.models.constant_velocity(
        sensors=ej.models.position_sensor(lambda p: p[1]), q=lambda p: p[0]
    )
    method, data = build(model), ej.stream(TIMES, VALUES)

    def loss(p):
        trace = ej.run(method, p, data, prior=PRIOR, t0=0.0)
        total = jnp.sum(trace.mean**2) + jnp.sum(trace.cov) + jnp.sum(trace.info.log_likelihood)
        return total, trace.info.status

    both, h = jax.jit(jax.value_and_grad(loss, has_aux=True)), 1e-6

    def value(p):
        return both(p)[0][0]

    (_, status), slope = both(AT)
    assert (status[LATE] == ej.Status.LATE_USED).all()
    assert status[-1] == ej.Status.TOO_LATE
    expected = [(value(AT.at[k].add(h)) - value(AT.at[k].add(-h))) / (2 * h) for k in range(2)]
    np.testing.assert_allclose(slope, expected, rtol=1e-6)
    still = AT.at[0].set(0.0)
    ahead = [value(still.at[0].add(k * h)) for k in range(3)]
    onward = (4 * ahead[1] - ahead[2] - 3 * ahead[0]) / (2 * h)
    np.testing.assert_allclose(both(still)[1][0], onward, rtol=1e-4)
