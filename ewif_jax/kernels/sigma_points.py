"""The unscented transform as a linearisation: a slope, and what a straight line leaves over."""

import jax.numpy as jnp
from jax import Array

from ewif_jax.fast.small import matmul
from ewif_jax.kernels import cholesky


def offsets(lower: Array, scale: Array) -> Array:
    """What is added to the mean (n, 2n): plus and minus the columns of sqrt(scale) `lower`."""
    columns = jnp.sqrt(scale) * lower
    return jnp.concatenate([columns, -columns], 1)


def regression(
    differences: Array, root: cholesky.Factor, scale: Array, centre: Array
) -> tuple[Array, Array, Array]:
    r"""Mean shift (m,), slope (m, n) and left-over covariance (m, m) of a function of a Gaussian.

    `differences` (m, 2n) are the function's values at the points minus its value at the mean,
    `root` the factor L of P, `scale` is c = n + lambda and `centre` the covariance weight of the
    central point. With :math:`d_j^\pm` the differences from the transformed mean,

    .. math::
        A L = \frac{d^+ - d^-}{2 \sqrt c}, \quad
        \Omega = \frac{(d^+ + d^-)(d^+ + d^-)'}{4 c} + w_0\, s s'

    The unscented covariances are then exactly :math:`P_{xy} = P A'`,
    :math:`P_{yy} = A P A' + \Omega`: nothing is subtracted, and a linear function leaves no
    :math:`\Omega`. Directions without variance have slope zero.
    """
    n = differences.shape[1] // 2
    shift = jnp.sum(differences, 1) / (2 * scale)
    around = (differences - shift[:, None]) / (2 * jnp.sqrt(scale))
    ahead, behind = around[:, :n], around[:, n:]
    bend = ahead + behind
    slope = cholesky.backward(root, (ahead - behind).T).T
    left_over = matmul(bend, bend.T) + centre * (shift[:, None] * shift[None, :])
    return shift, slope, left_over
