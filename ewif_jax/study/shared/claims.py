"""What a paper says and what we find, with the standard error that decides between them."""

import math
from collections.abc import Callable, Iterable
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from ewif_jax.study.shared.experiment import Measured

SIGMAS = 2.0
"""how many standard errors decide"""


class Claim(NamedTuple):
    """A row of a table of claims before anything is measured.

    text and published: what is compared, and what the paper says of it; decider: evidence -> the
    number that decides; reason, above, below and sigmas as in `claim`.
    """

    text: str
    published: str
    decider: Callable[[Any], Any]
    reason: str = ""
    above: float = -math.inf
    below: float = math.inf
    sigmas: float = SIGMAS


def judged(stated: Claim, ours: Measured) -> dict[str, Any]:
    """The row of the table that `ours` makes of a claim."""
    limits = {"above": stated.above, "below": stated.below, "sigmas": stated.sigmas}
    return claim(stated.text, stated.published, ours, reason=stated.reason, **limits)


def ratio(squared: np.ndarray, other: np.ndarray) -> Measured:
    """Ratio of two RMSEs from mean squares (R,) of the same runs, with the standard error of their
    joint scatter (delta method); unknown from fewer than two runs."""
    if squared.size < 2:
        return Measured(math.nan, math.nan)
    value = float(np.sqrt(squared.mean() / other.mean()))
    apart = squared / squared.mean() - other / other.mean()
    return Measured(value, float(value * apart.std(ddof=1) / (2 * np.sqrt(apart.size))))


def quotient(one: Measured, other: Measured) -> Measured:
    """Of two independent numbers, with its standard error (delta method)."""
    value = one.value / other.value
    return Measured(
        value, abs(value) * math.hypot(one.error / one.value, other.error / other.value)
    )


def share(events: np.ndarray) -> Measured:
    """How often something happened (R,) bool, with its standard error: of at least half an event,
    so that never is not known exactly."""
    count = events.size
    p = float(events.mean())
    safe = min(max(p, 0.5 / count), 1 - 0.5 / count)
    return Measured(p, float(np.sqrt(safe * (1 - safe) / count)))


def surest(ratios: Iterable[Measured]) -> Measured:
    """The ratio that is above 1 by the most standard errors. Taken as one of T, it is beyond noise
    if it is above by `at_any_of(T)`; if it is below 1, all are."""
    return max(ratios, key=lambda one: (one.value - 1) / max(one.error, 1e-300))


def at_any_of(count: int) -> float:
    """How many standard errors make the surest of `count` numbers as sure as `SIGMAS` make one
    (Bonferroni)."""
    return -NormalDist().inv_cdf(NormalDist().cdf(-SIGMAS) / count)


def claim(
    text: str,
    published: str,
    ours: Measured,
    *,
    above: float = -math.inf,
    below: float = math.inf,
    sigmas: float = SIGMAS,
    reason: str = "",
) -> dict[str, Any]:
    """A row of a table of claims: it holds if `ours` is between the limits by `sigmas` standard
    errors, does not if it is beyond one of them by as much, and else is "not beyond noise". Where
    it does not hold, the row says why: `reason`, or else that it is undecided or unexplained."""
    margin = min(ours.value - above, below - ours.value)
    sure = sigmas * ours.error
    holds = "yes" if margin > sure else "no" if margin < -sure else "not beyond noise"
    default = {"yes": "", "no": "unexplained", "not beyond noise": "too few runs to tell"}[holds]
    test = f"> {above:g}" if below == math.inf else f"< {below:g}"
    if above > -math.inf and below < math.inf:
        test = f"{above:g} to {below:g}"
    if sigmas != SIGMAS:
        test += f" by {sigmas:.2g} s.e."
    return {
        "claim": text,
        "published": published,
        "ours": ours,
        "holds if": test,
        "holds": holds,
        "reason": default if holds == "yes" else reason or default,
    }
