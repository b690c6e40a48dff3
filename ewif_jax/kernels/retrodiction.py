"""The inside of an interval, seen from its ends."""

from jax import Array

from ewif_jax.fast.small import matmul
from ewif_jax.kernels import cholesky


def bridge(Q_before: Array, F_after: Array, Q_after: Array) -> tuple[Array, Array]:
    r"""The state inside an interval given both of its ends.

    With :math:`x_d = F_1 x_a + w_1,\; x_c = F_2 x_d + w_2`: the gain
    :math:`G = Q_1 F_2' (F_2 Q_1 F_2' + Q_2)^{-1}` (n, n) on x_c, and the covariance
    :math:`Q_1 - G F_2 Q_1` (n, n) of x_d given x_a and x_c. The noise may be singular or zero.
    """
    cross = matmul(F_after, Q_before)
    f = cholesky.factor(matmul(cross, F_after.T) + Q_after)
    # With root = L^-1 F2 Q1 both results come from one triangular solve: G' = L'^-1 root, and G F2
    # Q1 = root' root, symmetric by construction.
    root = cholesky.forward(f, cross)
    return cholesky.backward(f, root).T, Q_before - matmul(root.T, root)
