"""What a paper says and what we find, with the standard error that decides between them."""

from typing import Any

import numpy as np

from ewif_jax.study.experiment import Measured


def ratio(squared: np.ndarray, other: np.ndarray) -> Measured:
    """Ratio of two RMSEs from mean squares (R,) of the same runs, with the standard error of their
    joint scatter (delta method)."""
    value = float(np.sqrt(squared.mean() / other.mean()))
    apart = squared / squared.mean() - other / other.mean()
    return Measured(value, float(value * apart.std(ddof=1) / (2 * np.sqrt(apart.size))))


def share(events: np.ndarray) -> Measured:
    """How often something happened (R,) bool, with its standard error: of at least half an event,
    so that never is not known exactly."""
    count = events.size
    p = float(events.mean())
    safe = min(max(p, 0.5 / count), 1 - 0.5 / count)
    return Measured(p, float(np.sqrt(safe * (1 - safe) / count)))


def claim(
    text: str, published: str, ours: Measured, *, above: Any = None, below: Any = None
) -> dict:
    """A row of a table of claims: it holds if `ours` is above or below the limit by two standard
    errors, does not if it is on the other side by as much, and else is "not beyond noise"."""
    limit, sign = (above, 1) if below is None else (below, -1)
    margin = sign * (ours.value - limit)
    sure = 2 * ours.error
    holds = "yes" if margin > sure else "no" if margin < -sure else "not beyond noise"
    test = f"{'>' if sign > 0 else '<'} {limit:g}"
    return {"claim": text, "published": published, "ours": ours, "holds if": test, "holds": holds}
