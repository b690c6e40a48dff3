"""What Orguner & Gustafsson say about their filters, each with the number of ours that decides."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ewif_jax.study.papers.turn.runs import (
    EKF,
    EKS,
    EXACT,
    EXT,
    ORD,
    PS,
    STD,
    TIMES,
    UKF,
    UKS,
)
from ewif_jax.study.shared.claims import Claim, at_any_of, judged, quotient, ratio, share, surest
from ewif_jax.study.shared.experiment import Measured
from ewif_jax.study.shared.folder import Arrays
from ewif_jax.study.shared.late import rmse_of
from ewif_jax.study.shared.one_by_one import seconds_per_run

SETTLED, LATER, LOST = 5, 20, 500.0
SECONDS = TIMES.size - SETTLED
"""how many seconds are compared one by one"""


class TurnEvidence(NamedTuple):
    """What was measured: of every filter, of the bounds, and how many numbers each filter holds."""

    found: dict[str, Arrays]
    bound: Arrays
    held: dict[str, int]


Decider = Callable[[TurnEvidence], Measured]


def settled_mean(found: Arrays, kind: str = "position") -> np.ndarray:
    """Mean squared error (R,) of the position or the velocity from 5 s on."""
    return found[kind][:, SETTLED:].mean(1)


def against(name: str, other: str) -> Decider:
    """The ratio of the RMS position errors of two filters on the runs that both were given."""

    def position_ratio(evidence: TurnEvidence) -> Measured:
        first, second = (evidence.found[each]["position"] for each in (name, other))
        runs = min(first.shape[0], second.shape[0])
        return ratio(*(settled_mean({"position": x[:runs]}) for x in (first, second)))

    return position_ratio


def surest_second(name: str, other: str) -> Decider:
    """The ratio of the RMS velocity errors of two filters where it is above 1 most surely."""

    def velocity_ratio(evidence: TurnEvidence) -> Measured:
        first, second = (evidence.found[each]["velocity"] for each in (name, other))
        return surest(ratio(first[:, -k], second[:, -k]) for k in range(1, SECONDS + 1))

    return velocity_ratio


def lost_runs(name: str) -> Decider:
    """How often a filter is far off late in a run."""
    return lambda evidence: share(
        evidence.found[name]["position"][:, LATER:].max(1) > LOST**2,
    )


def over_the_bound(evidence: TurnEvidence) -> Measured:
    """The velocity error of PFord in units of the parametric bound."""
    floor = np.sqrt(np.mean(evidence.bound["parametric_velocity"][SETTLED:]))
    velocity = rmse_of(settled_mean(evidence.found[ORD], "velocity"))
    return Measured(velocity.value / floor, velocity.error / floor)


def storage_ratio(evidence: TurnEvidence) -> Measured:
    """Numbers that PFoosmEXT keeps only for late data, over those of PFoosmEKS."""
    held = evidence.held
    return Measured((held[EXT] - held[STD]) / (held[EKS] - held[STD]), 0.0)


def smoother_cost(evidence: TurnEvidence) -> Measured:
    """Time that PFoosmPS takes for a late measurement, in steps of the filter that drops them."""
    late, in_sequence = evidence.found[PS], evidence.found[STD]
    whole = quotient(*(seconds_per_run(x["core_seconds"]) for x in (late, in_sequence)))
    steps = TIMES.size / late["late_used"].mean()
    return Measured((whole.value - 1) * steps, whole.error * steps)


FEW = "what uses late data differs by 1 to 3 %, which only many runs tell"
EARLY = (
    "it is further off early, and is back by then; the discretisation of the model is not printed"
)
PAIRS = (
    "a density for every pair of its particles and those of the filter, which the paper does not"
    " count"
)
EVERY = at_any_of(SECONDS)
FAR_OFF = f"is {LOST:g} m off after {LATER} s (share)"
SECOND = "over PFstd, velocity, the surest second"
BEYOND = "PFord over the parametric bound without late data (velocity)"
KEPT = "numbers kept for late data: PFoosmEXT over PFoosmEKS"
COST = "cost of a late measurement in PFoosmPS over that of an ordinary step"
EKS_OVER = "PFoosmEKS over"

# fields: claim, published, what decides, and the limits within which it holds
CLAIMS = (
    Claim("PFord over PFoosmEKS (position)", "PFord is best", against(ORD, EKS), below=1),
    Claim(f"{EKS_OVER} PFstd (position)", "late data help", against(EKS, STD), below=1),
    Claim(
        f"{EKS_OVER} PFoosmEXT (position)", "comparable", against(EKS, EXT), above=0.95, below=1.05
    ),
    Claim(f"{EKS_OVER} PFoosmEXT (position)", "EKS is best", against(EKS, EXT), FEW, below=1),
    Claim(f"{EKS_OVER} PFoosmUKS (position)", "EKS is best", against(EKS, UKS), FEW, below=1),
    Claim("PFoosmPS over PFoosmEKS (position)", "slightly worse", against(PS, EKS), FEW, above=1),
    Claim(f"PFoosmUKS {SECOND}", "at times worse", surest_second(UKS, STD), above=1, sigmas=EVERY),
    Claim(f"PFoosmEKS {SECOND}", "not said", surest_second(EKS, STD), above=1, sigmas=EVERY),
    Claim(BEYOND, "cannot beat it", over_the_bound, above=1),
    Claim(f"{EKF} over PFstd (position)", "not a rival", against(EKF, STD), above=1),
    Claim(
        f"runs in which the {EKF} {FAR_OFF}", "failed to converge", lost_runs(EKF), EARLY, above=0.5
    ),
    Claim(f"{UKF} over PFstd (position)", "not a rival", against(UKF, STD), above=1),
    Claim(
        f"runs in which the {UKF} {FAR_OFF}", "failed to converge", lost_runs(UKF), EARLY, above=0.5
    ),
    Claim(KEPT, "much less storage", storage_ratio, above=100),
    Claim(COST, "about half", smoother_cost, PAIRS, below=0.75),
    Claim(
        f"{EKS_OVER} exact replay (position)",
        "not tried",
        against(EKS, EXACT),
        above=0.95,
        below=1.05,
    ),
)


def turn_claims(
    found: dict[str, Arrays], bound: Arrays, held: dict[str, int]
) -> list[dict[str, Any]]:
    """What the paper says about its filters, and one comparison that it does not make."""
    evidence = TurnEvidence(found, bound, held)
    return [judged(each, each.decider(evidence)) for each in CLAIMS]
