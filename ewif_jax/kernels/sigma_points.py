"""The unscented transform as a linearisation: a slope, and what a straight line leaves over."""

from functools import cache
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.fast.small import matmul, matvec
from ewif_jax.kernels import cholesky, gaussian, symmetric


class Regression(NamedTuple):
    """A function of a Gaussian of covariance L L' as a straight line: the shift (m,) of its mean,
    its slope (m, n) along the columns of L, and the covariance (m, m) that the line leaves over."""

    shift: Array
    slope: Array
    left_over: Array


def offsets(lower: Array, scale: Array) -> Array:
    """What is added to the mean (n, 2n): plus and minus the columns of sqrt(scale) `lower`."""
    columns = jnp.sqrt(scale) * lower
    return jnp.concatenate([columns, -columns], 1)


def regression(differences: Array, scale: Array, centre: Array) -> Regression:
    r"""The straight line through a function of a Gaussian.

    `differences` (m, 2n) are the function's values at the points minus its value at the mean,
    `scale` is c = n + lambda and `centre` the covariance weight of the central point. With
    :math:`d_j^\pm` the differences from the transformed mean and :math:`A` the slope,

    .. math::
        D = A L = \frac{d^+ - d^-}{2 \sqrt c}, \quad
        \Omega = \frac{(d^+ + d^-)(d^+ + d^-)'}{4 c} + w_0\, s s'

    The unscented covariances are then exactly :math:`P_{xy} = L D'`,
    :math:`P_{yy} = D D' + \Omega`: nothing is subtracted, and a linear function leaves no
    :math:`\Omega`.
    """
    n = differences.shape[1] // 2
    shift = jnp.sum(differences, 1) / (2 * scale)
    around = (differences - shift[:, None]) / (2 * jnp.sqrt(scale))
    ahead, behind = around[:, :n], around[:, n:]
    # The difference of both sides is the slope, their sum what is even in the offset: that a
    # straight line cannot say. A linear function leaves nothing over.
    bend = ahead + behind
    left_over = matmul(bend, bend.T) + centre * (shift[:, None] * shift[None, :])
    return Regression(shift, ahead - behind, left_over)


@cache
def gauss_hermite(n: int, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, order^n) and positive weights of sum one, which give the mean of every polynomial
    of degree up to 2 order - 1 in each of n independent standard normal numbers."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(order)
    weights = weights / weights.sum()
    points = np.array(list(product(nodes, repeat=n))).T
    return points, np.array([np.prod(w) for w in product(weights, repeat=n)])


def quadrature(differences: Array, points: Array, weights: Array) -> Regression:
    r"""The straight line through a function of a Gaussian, by points (n, N) of a quadrature.

    `differences` (m, N) are the function's values at the points minus its value at the mean. With
    weights :math:`w_i` and :math:`d_i` the differences,

    .. math::
        s = \sum_i w_i d_i, \quad D = \sum_i w_i (d_i - s) \xi_i', \quad
        \Omega = \sum_i w_i e_i e_i', \quad e_i = d_i - s - D \xi_i

    so that :math:`P_{yy} = D D' + \Omega` is a sum of squares, as in `regression`.
    """
    shift = matmul(differences, weights[:, None])[:, 0]
    around = differences - shift[:, None]
    slope = matmul(around * weights[None], points.T)
    bend = around - matmul(slope, points)
    return Regression(shift, slope, matmul(bend * weights[None], bend.T))


def slope_of(line: Regression, root: cholesky.Factor) -> Array:
    """The slope A (m, n) along the axes: zero in directions without variance."""
    return cholesky.backward(root, line.slope.T).T


def update_by_points(
    mean: Array, lower: Array, difference: Array, slope: Array, R: Array, mask: Array
) -> tuple[Array, Array, gaussian.Innovation]:
    r"""Mean and packed covariance of a Gaussian of covariance L L' after a measurement, with the
    innovation; `slope` D (m, n) along the columns of L, `R` (m, m) all that is not D D'.

    .. math::
        W = S^{-1} D, \quad K = L W', \quad P = T T' + K R K', \quad T = L (I - W' D)

    the Joseph form in units of L: squares, so that no variance is below zero, and without the
    slope along the axes, which would be a quotient by the smallest variances of L.
    """
    D, R = jnp.where(mask[:, None], slope, 0), gaussian.mask_cov(R, mask)
    cov = matmul(D, D.T) + R
    factor = cholesky.factor(cov)
    weights = cholesky.solve(factor, D)
    gain = matmul(lower, weights.T)
    value = jnp.where(mask, difference, 0)
    # P (I - W'D) in roots: T = L (I - W'D) is P's root after the gain, and K R K' what the gain
    # lets in of the noise. Both are squares, so no variance can come out negative.
    left = matmul(lower, jnp.eye(mean.shape[0], dtype=mean.dtype) - matmul(weights.T, D))
    packed = symmetric.pack(matmul(left, left.T) + matmul(matmul(gain, R), gain.T))
    packed = gaussian.cleared(packed, symmetric.pack(matmul(lower, lower.T)), R, cov)
    innovation = gaussian.Innovation(value, cov, factor, matmul(D, lower.T))
    return mean + matvec(gain, value), packed, innovation
