"""A late measurement seen from now: what the process noise since then does to it."""

from jax import Array

from ewif_jax.kernels import cholesky, symmetric
from ewif_jax.kernels.small import fence, matmul


def noise_gain(predicted_cov: Array, Q: Array) -> tuple[Array, Array]:
    """Q M^-1 (n, n) and L^-1 Q (n, n) with M = L L', the packed `predicted_cov`.

    Q M^-1 maps "new estimate minus prediction" to the expected process noise. Q is part of M, so a
    singular M needs no inverse: directions without variance are skipped.
    """
    f = cholesky.factor(symmetric.unpack(predicted_cov))
    root = fence(cholesky.forward(f, Q))
    return fence(cholesky.backward(f, root).T), root


def bridge(Q_before: Array, F_after: Array, Q_after: Array) -> tuple[Array, Array]:
    r"""The state inside an interval given both of its ends.

    With :math:`x_d = F_1 x_a + w_1,\; x_c = F_2 x_d + w_2`: the gain
    :math:`G = Q_1 F_2' (F_2 Q_1 F_2' + Q_2)^{-1}` (n, n) on x_c, and the covariance
    :math:`Q_1 - G F_2 Q_1` (n, n) of x_d given x_a and x_c. The noise may be singular or zero.
    """
    cross = matmul(F_after, Q_before)
    f = cholesky.factor(matmul(cross, F_after.T) + Q_after)
    root = cholesky.forward(f, cross)
    return cholesky.backward(f, root).T, Q_before - matmul(root.T, root)
