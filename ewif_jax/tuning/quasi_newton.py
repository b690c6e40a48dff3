"""A quasi-Newton method for few numbers: symmetric rank-one updates in a trust region.

It asks for values and gradients and sees nothing else: a generator that yields points (n,) and is
sent (value, gradient) of each, so that descents from many starts go on side by side, one batched
evaluation a turn. Far from an optimum a likelihood is no parabola: it falls exponentially, or is
flat and bends down. Rank-one updates may be indefinite and say so, and the region's radius then
decides how far to go; a Broyden-Fletcher-Goldfarb-Shanno update would stay positive, and crawl.
"""

from collections.abc import Generator
from typing import NamedTuple

import numpy as np

Asked = Generator[np.ndarray, tuple[float, np.ndarray], "Ended"]
"""Yields a point, is sent value and gradient there, and returns why it ended."""

FARTHEST = 5.0
"""The longest step: a parameter in logarithms changes by less than a factor 150."""
SMALLEST = 1e-7
"""The radius below which no step is tried."""
LOOKS = np.log(10.0) * np.array([1, 2, 4, 6, 8, 12, 16, 24, 32])
"""How far it looks around from an optimum, both ways along each parameter that has a bound: a
factor 10 and 100, and on while the loss is flat there. What is lower starts another descent."""
SURE_LOOKS = 2
MOST_LOOKS = 6
"""Of how many parameters."""


class SeenPoint(NamedTuple):
    """A point (n,), its value and gradient (n,)."""

    point: np.ndarray
    value: float
    gradient: np.ndarray

    @property
    def is_finite(self) -> bool:
        """Whether a descent can go on from here."""
        return bool(np.isfinite(self.value) and np.isfinite(self.gradient).all())


class Ended(NamedTuple):
    """Why a descent ended: converged, or in a few words why not; which numbers (n,) ran to an end
    of their range: -1, 0 or 1; whether a step led to where nothing is finite."""

    reason: str
    ends: np.ndarray
    refused: bool = False


def quasi_newton(
    start: np.ndarray, widths: np.ndarray, has_ends: np.ndarray, rounding: float
) -> Asked:
    """Descends from `start`, looks around, and descends again from what is lower.

    Args:
        start: (n,).
        widths: (n,) what a step of some size is in each number.
        has_ends: (n,) which numbers stand for a parameter with a bound, infinitely far away.
        rounding: the relative error of a value.
    """
    asking = _in_units(start / widths, has_ends, rounding)
    point = next(asking)
    while True:
        value, gradient = yield point * widths
        try:
            point = asking.send((value, gradient * widths))
        except StopIteration as end:
            return end.value


def _in_units(start: np.ndarray, has_ends: np.ndarray, rounding: float) -> Asked:
    value, gradient = yield start
    best = SeenPoint(start, value, gradient)
    ends = np.zeros(len(start), int)
    if not best.is_finite:
        return Ended("not finite", ends)
    refused, reason = False, ""
    for _ in range(3):
        best, reason, left = yield from _descent_result(best, rounding)
        refused |= left
        tolerance = rounding * abs(best.value)
        lower, ends = yield from _looked_around(best, best.point - start, has_ends, tolerance)
        if lower is None:
            break
        best = lower
    return Ended(reason, ends, refused)


def _descent_result(
    seen: SeenPoint, rounding: float
) -> Generator[np.ndarray, tuple[float, np.ndarray], tuple[SeenPoint, str, bool]]:
    """The end of one descent, why it ended, and whether a step was refused as not finite."""
    n, refused, fresh, earlier = len(seen.point), False, 0, seen.value
    # A first step of length 1 along the gradient: in logarithms a factor e, whatever the loss is
    # measured in.
    curvature, radius = np.eye(n) * np.linalg.norm(seen.gradient), 1.0
    while True:
        # A least value of 0 is approached in relation to how far it has just fallen.
        tolerance = rounding * max(abs(seen.value), abs(earlier - seen.value))
        step = shortest(curvature, seen.gradient, radius)
        expected = -seen.gradient @ step - step @ curvature @ step / 2
        if radius < SMALLEST:
            return seen, "converged", refused
        if expected <= tolerance:
            # A curvature that was met far away may be far too large here: it starts afresh.
            steep = np.linalg.norm(seen.gradient) * min(radius, 1) > 1e6 * tolerance
            if not steep or fresh > 1:
                flat = np.linalg.norm(step) >= 0.99 * radius and radius >= 1
                return seen, "flat" if flat else "converged", refused
            curvature, radius = np.eye(n) * np.linalg.norm(seen.gradient) / radius, radius
            fresh += 1
            continue
        value, gradient = yield seen.point + step
        tried = SeenPoint(seen.point + step, value, gradient)
        length = float(np.linalg.norm(step))
        if not tried.is_finite:
            refused, radius = True, length / 4
            continue
        gained = (seen.value - value) / expected
        # Also after a step that is not taken: its gradient says as much about the curvature as any.
        curvature = _updated_curvature(curvature, step, gradient - seen.gradient)
        if gained < 0.1:
            radius = length / 4
        elif gained > 0.7 and length > 0.8 * radius:
            radius = min(2 * radius, FARTHEST)
        if gained > 0:
            earlier, seen = seen.value, tried


def _looked_around(
    seen: SeenPoint, way: np.ndarray, has_ends: np.ndarray, tolerance: float
) -> Generator[np.ndarray, tuple[float, np.ndarray], tuple[SeenPoint | None, np.ndarray]]:
    """The lowest point around, if it is lower, and which numbers can move on in one direction for
    nothing (in both: that of `way` (n,), by which it came)."""
    ends = np.zeros(len(seen.point), int)
    lowest = None
    if has_ends.sum() > MOST_LOOKS:
        return None, ends
    for k in np.flatnonzero(has_ends):
        for sign in (-1, 1) if way[k] > 0 else (1, -1):
            flat = True
            for distance in LOOKS:
                if not flat and distance > LOOKS[SURE_LOOKS - 1]:
                    break
                there = seen.point.copy()
                there[k] += sign * distance
                value, gradient = yield there
                tried = SeenPoint(there, value, gradient)
                flat &= abs(value - seen.value) <= 1e-4 * abs(seen.value)
                below = seen.value - 10 * tolerance if lowest is None else lowest.value
                if tried.is_finite and value < below:
                    lowest = tried
            if flat:
                ends[k] = sign
    return lowest, ends


def shortest(curvature: np.ndarray, gradient: np.ndarray, radius: float) -> np.ndarray:
    """The step (n,) within `radius` to the least of g'p + p'Bp / 2."""
    values, vectors = np.linalg.eigh(curvature)
    along = vectors.T @ gradient
    # The step of the trust region solves (B + mu) p = -g with the least mu >= -lambda_min for which
    # |p| fits; |p| falls as mu grows, so halving the interval finds it (More & Sorensen 1983).
    floor = max(0.0, -values[0])
    if values[0] > 0 and np.linalg.norm(along / values) <= radius:
        return -vectors @ (along / values)
    low, high = floor, floor + np.linalg.norm(gradient) / radius + 1e-300
    for _ in range(100):
        middle = (low + high) / 2
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            too_long = not np.linalg.norm(along / (values + middle)) <= radius
        low, high = (middle, high) if too_long else (low, middle)
    step = -along / np.maximum(values + high, 1e-300)
    left = radius**2 - step @ step
    if values[0] <= 0 and left > 1e-6 * radius**2:
        # Nothing pulls along the direction that bends down: either way is as good.
        step[0] += np.sqrt(left) if step[0] >= 0 else -np.sqrt(left)
    return vectors @ step


def _updated_curvature(curvature: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    missed = change - curvature @ step
    along = missed @ step
    # The safeguard of symmetric rank-one: the denominator may vanish though nothing is wrong, and
    # the update is then left out (Nocedal & Wright, (6.26)).
    if abs(along) <= 1e-8 * np.linalg.norm(step) * np.linalg.norm(missed):
        return curvature
    return curvature + np.outer(missed, missed) / along
