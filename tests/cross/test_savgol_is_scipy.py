"""Savitzky-Golay coefficients from the polynomial model, against SciPy and exact arithmetic."""

from fractions import Fraction
from math import factorial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import savgol_coeffs

from ewif_jax.smoothers.savgol import savgol


@pytest.mark.parametrize(
    ("length", "order", "deriv", "delta", "pos"),
    [
        (5, 2, 0, 1.0, None),
        (5, 2, 1, 0.3, 0),
        (11, 3, 2, 0.1, 10),
        (6, 2, 0, 1.0, None),
        (6, 2, 1, 2.0, 1.25),
        (9, 2, 3, 1.0, None),
        (3, 0, 0, 1.0, 2),
    ],
)
def test_coefficients(length, order, deriv, delta, pos):
    ours = savgol(length, order, deriv=deriv, delta=delta, pos=pos)
    scipys = savgol_coeffs(length, order, deriv=deriv, delta=delta, pos=pos, use="dot")
    assert_allclose(ours, scipys, rtol=1e-9, atol=1e-11)


def test_high_orders_are_exact():
    """Against rational arithmetic, which loses no digits."""
    length, order = 25, 5
    exact = _exact(length, order)
    assert_allclose(savgol(length, order), exact, rtol=0, atol=1e-12 * np.abs(exact).max())


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ((5, 5), "polyorder"),
        ((0, 0), "window_length"),
        ((5, 2, {"pos": 5}), "pos"),
        ((5, 2, {"delta": 0.0}), "delta"),
    ],
)
def test_bad_sizes_are_named(arguments, word):
    length, order, *rest = arguments
    with pytest.raises(ValueError, match=word):
        savgol(length, order, **(rest[0] if rest else {}))


def _exact(length, order, deriv=0):
    grid = [Fraction(i) - Fraction(length - 1, 2) for i in range(length)]
    size = order + 1
    rows = [[sum(x ** (i + j) for x in grid) for j in range(size)] for i in range(size)]
    rows = [[*row, Fraction(int(i == deriv))] for i, row in enumerate(rows)]
    for i in range(size):
        k = next(k for k in range(i, size) if rows[k][i] != 0)
        rows[i], rows[k] = rows[k], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for k in range(size):
            if k != i:
                rows[k] = [a - rows[k][i] * c for a, c in zip(rows[k], rows[i], strict=True)]
    solved = [row[-1] for row in rows]
    values = [factorial(deriv) * sum(c * x**j for j, c in enumerate(solved)) for x in grid]
    return np.array([float(v) for v in values])
