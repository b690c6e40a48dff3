"""The joint Fisher information of a trajectory, dense, and what it leaves for its last state.

`F(x, t0, t1)` and `H(x, sensor)` are Jacobians at a true state x, `Q(t0, t1)` the noise of an
interval, which must be invertible.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from .dense import Array, Floats, matrix

Path = Callable[[float], ArrayLike]
"""The true state at a time."""


def bound(
    paths: Sequence[Path],
    *,
    t0: float,
    prior_cov: ArrayLike,
    F: Callable[[Array, float, float], ArrayLike],
    Q: Callable[[float, float], ArrayLike],
    times: Floats,
    H: Callable[[Array, int], ArrayLike],
    R: ArrayLike,
    sensors: Sequence[int],
    report: float,
) -> Array:
    """Return the bound at `report` >= all `times`: the last block of the inverse of

    E[sum over intervals of [F, -1]' Q^-1 [F, -1] + sum over measurements of H' R^-1 H] + prior,

    over the states at t0, at all distinct times, and at the report; E over the given paths.
    """
    grid = np.unique([t0, *times, report])
    prior = np.linalg.inv(matrix(prior_cov))
    n = len(prior)
    J = np.zeros((grid.size * n, grid.size * n))
    J[:n, :n] = prior
    for path in paths:
        for k in range(grid.size - 1):
            a, c = grid[k], grid[k + 1]
            rows = np.hstack([matrix(F(np.asarray(path(a)), a, c)), -np.eye(n)])
            block = slice(k * n, (k + 2) * n)
            J[block, block] += rows.T @ np.linalg.inv(matrix(Q(a, c))) @ rows / len(paths)
        for t, sensor in zip(times, sensors, strict=True):
            at = int(np.flatnonzero(grid == t)[0]) * n
            h = matrix(H(np.asarray(path(t)), sensor))
            seen = h.T @ np.linalg.inv(matrix(R)) @ h / len(paths)
            J[at : at + n, at : at + n] += seen
    last = slice((grid.size - 1) * n, None)
    return np.linalg.inv(J)[last, last]


def equivalent(
    path: Path,
    *,
    t0: float,
    prior_cov: ArrayLike,
    F: Callable[[Array, float, float], ArrayLike],
    Q: Callable[[float, float], ArrayLike],
    times: Floats,
    H: Callable[[Array, int], ArrayLike],
    R: ArrayLike,
    sensors: Sequence[int],
    reports: Floats,
    back: Callable[[Array, float, float], ArrayLike],
) -> list[Array]:
    """Return the inverses of (64) with D of (65)-(67), each measurement replaced by (69) and (70)
    with a plus; `back(x, t1, t0)` is the state x without noise at the earlier t0."""
    J, now, found = np.linalg.inv(matrix(prior_cov)), t0, []
    for t, sensor, report in zip(times, sensors, reports, strict=True):
        if report > now:
            f = matrix(F(np.asarray(path(now)), now, report))
            q = np.linalg.inv(matrix(Q(now, report)))
            J = q - q @ f @ np.linalg.inv(f.T @ q @ f + J) @ f.T @ q
            now = report
        x = np.asarray(path(report))
        h = matrix(H(np.asarray(back(x, report, t)), sensor)) @ matrix(F(x, report, t))
        noise = matrix(R) + (h @ matrix(Q(t, report)) @ h.T if report > t else 0.0)
        J = J + h.T @ np.linalg.inv(noise) @ h
        found.append(np.linalg.inv(J))
    return found
