"""What Pornsarayouth & Yamakita say about their filters, each with the number of ours that
decides."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ewif_jax.study.papers.two_bearings.runs import (
    DELAYS,
    EKF,
    ENKF1,
    ENKF2,
    EXACT,
    HALF,
    ONE,
    OTHER,
    PF,
    RTS,
    SHARED,
)
from ewif_jax.study.shared.claims import Claim, judged, quotient, ratio, share, surest
from ewif_jax.study.shared.experiment import Measured
from ewif_jax.study.shared.folder import Arrays
from ewif_jax.study.shared.late import mean_of
from ewif_jax.study.shared.one_by_one import seconds_per_run

NONE, FIVE, TEN = range(3)
"""which of `DELAYS`"""
SETTLED, LOST = 20.0, 50.0
ALL_FIVE = (EKF, RTS, ENKF1, ENKF2, PF)
RIVALS = (EKF, RTS, ENKF2, SHARED, EXACT)


class BearingsEvidence(NamedTuple):
    """By filter: mean squared errors `off`, squared mean standard deviations `sd` (D, R), runs that
    are `gone`, and seconds on one core; `printed`: the square of the published bound (D, R)."""

    off: dict[str, np.ndarray]
    sd: dict[str, np.ndarray]
    gone: dict[str, np.ndarray]
    seconds: dict[str, np.ndarray]
    printed: np.ndarray

    def kept(self, delay: int, *names: str) -> np.ndarray:
        """The runs (R,) that none of the filters lost."""
        return ~np.any([self.gone[name][delay] for name in names], 0)


Decider = Callable[[BearingsEvidence], tuple[Measured, int | None]]
"""Gives the number that decides, and from how many runs it comes (None: all)."""


def squared(error: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Mean squared position error (D, R) after the filters have settled."""
    return _settled_means(np.sum(error**2, -1), times)


def reported(variance: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Mean standard deviation of the position (D, R) after the filters have settled."""
    return _settled_means(np.sqrt(np.sum(variance, -1)), times)


def lost(error: np.ndarray) -> np.ndarray:
    """Which runs (D, R) were ever far off."""
    return np.nanmax(np.sum(error**2, -1), -1) > LOST**2


def error_ratio(name: str, other: str) -> Decider:
    """RMSE over RMSE at 10 s, of the runs that neither filter lost."""

    def decided(evidence: BearingsEvidence) -> tuple[Measured, int | None]:
        both = evidence.kept(TEN, name, other)
        pair = (evidence.off[each][TEN][both] for each in (name, other))
        return ratio(*pair), int(both.sum())

    return decided


def spread_ratio(name: str, other: str) -> Decider:
    """SD over SD at 5 s, of the runs that neither filter lost."""

    def decided(evidence: BearingsEvidence) -> tuple[Measured, int | None]:
        both = evidence.kept(FIVE, name, other)
        pair = (evidence.sd[each][FIVE][both] for each in (name, other))
        return ratio(*pair), int(both.sum())

    return decided


def time_ratio(name: str, other: str) -> Decider:
    """Seconds a run over seconds a run."""
    return lambda evidence: (
        quotient(*(seconds_per_run(evidence.seconds[each]) for each in (name, other))),
        None,
    )


def lost_share(name: str, delay: int) -> Decider:
    """How often a filter loses the target."""
    return lambda evidence: (share(evidence.gone[name][delay]), None)


def lost_more_often(name: str, other: str, delay: int) -> Decider:
    """How much more often a filter loses the target than another, run by run."""
    return lambda evidence: (
        mean_of(evidence.gone[name][delay].astype(float) - evidence.gone[other][delay]),
        None,
    )


def lost_by_both(name: str, other: str, delay: int) -> Decider:
    """How often both filters lose the target."""
    return lambda evidence: (share(evidence.gone[name][delay] & evidence.gone[other][delay]), None)


def spread_of_five(evidence: BearingsEvidence) -> tuple[Measured, int | None]:
    """The largest over the smallest SD of five filters without delay."""
    alike = evidence.kept(NONE, *ALL_FIVE)
    ranked = sorted(ALL_FIVE, key=lambda name: evidence.sd[name][NONE][alike].mean())
    pair = (evidence.sd[name][NONE][alike] for name in (ranked[-1], ranked[0]))
    return ratio(*pair), int(alike.sum())


def nearest_rival(evidence: BearingsEvidence) -> tuple[Measured, int | None]:
    """RMSE over that of EnKF1 at 5 s, of the filter from which EnKF1 differs least surely."""
    both = {name: evidence.kept(FIVE, ENKF1, name) for name in RIVALS}
    off = evidence.off
    nearest = surest(
        ratio(off[name][FIVE][runs], off[ENKF1][FIVE][runs]) for name, runs in both.items()
    )
    return nearest, min(int(runs.sum()) for runs in both.values())


def printed_bound(evidence: BearingsEvidence) -> tuple[Measured, int | None]:
    """The bound as printed over the SD of the EKF at 5 s."""
    seen = evidence.kept(FIVE, EKF)
    pair = (x[FIVE][seen] for x in (evidence.printed, evidence.sd[EKF]))
    return ratio(*pair), int(seen.sum())


FEW = "a difference of 2 or 3 %, which a hundred runs hardly tell"
AT_TEN = f"at {DELAYS[TEN]:g} s (RMSE ratio)"
AT_FIVE = f"at {DELAYS[FIVE]:g} s (SD ratio)"
FIVE_ALIKE = "largest over smallest SD of five filters at 0 s"
ALONE = "runs lost by either sensor when alone, at 5 s (share)"
NEAREST = "nearest rival over EnKF1 at 5 s (RMSE ratio)"
HALF_LOST = "lost with half the particles, less lost with all, at 5 s (share)"
PF_LOST = "lost by the PF, less lost by EnKF2, at 10 s (share)"
PRINTED = "the printed bound over the SD of the EKF at 5 s"
OWN = "not tried"

# fields: claim, published, what decides, and the limits within which it holds
CLAIMS = (
    Claim(FIVE_ALIKE, "close to one another", spread_of_five, below=1.5),
    Claim(ALONE, "false tracking", lost_by_both(ONE, OTHER, FIVE), above=0.5),
    Claim(NEAREST, "EnKF1 is the worst", nearest_rival, below=1),
    Claim("runs that EnKF2 loses at 5 s (share)", "very good", lost_share(ENKF2, FIVE), below=0.1),
    Claim(HALF_LOST, "unstable with 5000", lost_more_often(HALF, PF, FIVE), above=0),
    Claim(f"{PF} over {EKF} {AT_FIVE}", "still high", spread_ratio(PF, EKF), above=1),
    Claim("runs that the PF loses at 10 s (share)", "unstable", lost_share(PF, TEN), above=0.3),
    Claim(PF_LOST, "EnKF2 is more stable", lost_more_often(PF, ENKF2, TEN), above=0),
    Claim(PRINTED, "much worse", printed_bound, above=1),
    Claim(f"{RTS} over {EKF} {AT_TEN}", "RTS is better", error_ratio(RTS, EKF), below=1),
    Claim(f"{RTS} over {ENKF2} {AT_TEN}", "RTS is better", error_ratio(RTS, ENKF2), below=1),
    Claim(f"{EKF} over {ENKF2} {AT_TEN}", "EKF is superior", error_ratio(EKF, ENKF2), FEW, below=1),
    Claim(f"{ENKF2} over {PF} (time ratio)", "consumes less", time_ratio(ENKF2, PF), below=1),
    Claim(f"{EKF} over {ENKF2} (time ratio)", "consumes less", time_ratio(EKF, ENKF2), below=1),
    Claim(f"{EXACT} over {RTS} {AT_TEN}", OWN, error_ratio(EXACT, RTS), below=1),
    Claim(f"{SHARED} over {ENKF2} {AT_TEN}", OWN, error_ratio(SHARED, ENKF2), below=1),
    Claim(f"{SHARED} over {EKF} {AT_TEN}", OWN, error_ratio(SHARED, EKF), below=1),
)


def bearings_claims(
    found: dict[str, Arrays], bound: Arrays, times: np.ndarray
) -> list[dict[str, Any]]:
    """What the paper says about its filters, and three comparisons it does not make."""
    evidence = BearingsEvidence(
        off={name: squared(x["error"], times) for name, x in found.items()},
        sd={name: reported(x["variance"], times) ** 2 for name, x in found.items()},
        gone={name: lost(x["error"]) for name, x in found.items()},
        seconds={name: x["core_seconds"].ravel() for name, x in found.items()},
        printed=reported(bound["published"], times) ** 2,
    )
    every = evidence.off[EKF].shape[1]
    rows = []
    for each in CLAIMS:
        ours, runs = each.decider(evidence)
        rows.append({"runs": every if runs is None else runs, **judged(each, ours)})
    return rows


def _settled_means(values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Means over the arrivals of (D, R, T) from 20 s on."""
    return np.stack([x[:, t >= SETTLED].mean(1) for x, t in zip(values, times, strict=True)])
