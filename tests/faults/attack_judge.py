"""What is right of a trace: the rules that hold for every filter, and a NumPy filter's numbers."""

import math
from typing import Any

import numpy as np

import ewif_jax as ej
from ewif_jax import Status
from faults.attack_worlds import Problem, filtered

IN_ORDER = {"kalman", "square_root", "information", "extended", "unscented"}
EXACT_LATE = {"replay", "asd"}
ONE_LATE = {"rts_reference"}
ONE_STEP = {"a1", "b1", "al1", "bl1", "selective"}
WEIGHTED = {"ewif", "drop_late"}
MAY_FORGET = WEIGHTED | {"ewif_bank", "limited_memory", "fixed_lag_ewif"}
"""Whose docstrings say that after a long gap nothing is known: NaN, and no innovation of what is
measured then."""


def broken_invariant(name: str, given: Problem, trace: ej.Trace) -> str:
    """The first rule that a trace breaks; empty if none."""
    status, (info, time) = trace.info.status, (trace.info, given.stream.time)
    present = given.stream.mask.any(1)
    used = (status == Status.USED) | (status == Status.LATE_USED)
    newest = np.maximum.accumulate(np.where(present & used, time, 0))
    before = np.append(np.zeros(1, time.dtype), newest[:-1])
    if trace.mean.dtype != time.dtype or trace.cov.dtype != time.dtype:
        return f"dtype {trace.mean.dtype} of a stream in {time.dtype}"
    if not np.isin(status, list(Status)).all():
        return f"unknown status {status}"
    if (status[~present] != Status.MASKED).any() or (status[present] == Status.MASKED).any():
        return "MASKED where something is present, or not where nothing is"
    late = time < before
    if (late & (status == Status.USED)).any() or (~late & (status == Status.LATE_USED)).any():
        return "USED and LATE_USED mixed up"
    if (~late & (status == Status.TOO_LATE)).any():
        return "TOO_LATE in sequence"
    if (info.log_likelihood[~used] != 0).any():
        return "log likelihood of a row that is not used"
    unseen = np.isin(status, (Status.TOO_LATE, Status.MASKED))
    if (info.innovation[unseen] != 0).any() or (
        info.innovation_cov[unseen] != np.eye(info.innovation.shape[1])
    ).any():
        return "innovation of a row that is TOO_LATE or MASKED"
    variances = np.diagonal(trace.cov, axis1=1, axis2=2)
    if (variances < 0).any():
        row = np.argwhere(variances < 0)[0][0]
        return f"negative variance {variances.min():.2g}, status {status[row]}"
    defined = np.isfinite(trace.mean).all(1) & np.isfinite(trace.cov).all((1, 2))
    if (used & ~defined).any() and name not in MAY_FORGET:
        return f"NaN with status USED at {np.flatnonzero(used & ~defined)[0]}"
    if np.isnan(info.log_likelihood).any():
        return "NaN likelihood"
    unknown = np.isnan(info.innovation).any(1)
    if (unknown & (info.log_likelihood != 0)).any() or (unknown.any() and name not in MAY_FORGET):
        return "NaN innovation"
    size = np.sqrt(np.maximum(variances, np.finfo(time.dtype).tiny))
    scaled = np.where(defined[:, None, None], trace.cov, 0) / (size[:, :, None] * size[:, None, :])
    if np.abs(scaled - scaled.swapaxes(1, 2)).max() > 1e-6:
        return "a covariance that is not symmetric"
    still = (trace.time[1:] == trace.time[:-1]) & ~used[1:] & defined[:-1]
    # Motion over no time is the identity but for the rounding of the model's own matrices.
    moved = np.abs(trace.mean[1:] - trace.mean[:-1]) / np.abs(trace.mean[1:]).max(1, keepdims=True)
    if (still & (moved > 100 * np.finfo(time.dtype).eps).any(1)).any():
        return "a row that is not used moved the estimate"
    return ""


def against_oracle(name: str, given: Problem, trace: ej.Trace) -> tuple[int, str]:
    """How many rows were compared, and what is wrong with the first that is."""
    used = np.isin(trace.info.status, (Status.USED, Status.LATE_USED))
    times, eps = np.asarray(given.stream.time, float), float(np.finfo(given.stream.time.dtype).eps)
    any_late = (trace.info.status == Status.LATE_USED).any()
    known = name in IN_ORDER | EXACT_LATE | WEIGHTED | {"fading"}
    known |= name in ONE_LATE and (trace.info.status == Status.LATE_USED).sum() < 2
    if not known and (name not in ONE_STEP | ONE_LATE or any_late):
        return 0, ""
    inflate, noisy = motion_of(name, given)
    compared, good = 0, 1e-6 if eps < 1e-10 else 1e-2
    for k in range(len(times)):
        if not given.stream.mask[k].any() or trace.info.status[k] == Status.TOO_LATE:
            continue
        rows, until = np.flatnonzero(used[: k + 1]), times[: k + 1][used[: k + 1]].max(initial=0)
        if not used[k]:  # was there a reason?
            until, rows = max(until, times[k]), np.append(rows, k)
        right = filtered(given, rows, until, inflate, noisy)
        rng = np.random.default_rng(k)
        blurred = [filtered(given, rows, until, inflate, noisy, (rng, eps)) for _ in range(4)]
        if right.singular or any(b.singular for b in blurred):
            break  # an exact measurement of what is known exactly has no one answer
        moments = [(b.mean, b.cov) for b in blurred]
        wrong = off_by(trace.mean[k], trace.cov[k], (right.mean, right.cov), moments, eps)
        if wrong is None:
            break  # beyond this rounding decides
        if not used[k]:
            if np.abs(given.stream.value[k]).max() > 1e15:
                continue
            return compared, f"REJECTED without a reason at {k}"
        if wrong:
            return compared, f"{wrong} at {k}"
        if trace.info.status[k] == Status.USED:
            density, apart = trace.info.log_likelihood[k], [b.log_density for b in blurred]
            allowed = 300 * np.abs(np.subtract(apart, right.log_density)).max()
            allowed += good * (1 + abs(right.log_density))
            if not abs(density - right.log_density) <= allowed:
                return compared, f"log density {density:.4g} for {right.log_density:.4g} at {k}"
        compared += 1
    return compared, ""


def expected_density(name: str, given: Problem) -> tuple[float, float] | None:
    """The average log density of the rows by the oracle, and what rounding may change; None if
    there are late or singular ones, or rounding decides."""
    if name not in IN_ORDER | EXACT_LATE | WEIGHTED | {"fading"} or given.traits["late"] != "none":
        return None
    eps = float(np.finfo(given.stream.time.dtype).eps)
    times = np.asarray(given.stream.time, float)
    rows = np.flatnonzero(np.asarray(given.stream.mask).any(1))
    rng, totals = np.random.default_rng(1), []
    for blur in (None, (rng, eps), (rng, eps), (rng, eps)):
        found = [
            filtered(given, rows[: k + 1], times[rows[k]], *motion_of(name, given), blur)
            for k in range(len(rows))
        ]
        if any(x.singular for x in found):
            return None
        totals.append(sum(x.log_density for x in found) / max(len(rows), 1))
    allowed = 300 * np.abs(np.subtract(totals[1:], totals[0])).max()
    return (totals[0], allowed + 1e-6 * (1 + abs(totals[0]))) if allowed < 0.1 else None


def motion_of(name: str, given: Problem) -> tuple[Any, bool]:
    """`inflate` and `noisy` of the oracle of a filter."""
    if name == "fading":
        return (lambda dt: float(given.params["fading"]) ** 2 if dt > 0 else 1.0), True
    if name in WEIGHTED:
        return (lambda dt: math.exp(dt / float(given.params["tau"]))), False
    return None, True


def off_by(mean: Any, cov: Any, right: Any, blurred: Any, eps: float) -> str | None:
    """What is wrong with a mean and covariance; None if rounding decides, which moves what is
    `right` to what is `blurred`."""
    good = 1e-6 if eps < 1e-10 else 1e-2
    floor = (eps * 1e2 * (1 + np.abs(right[0]).max())) ** 2
    sigma = np.sqrt(np.maximum(np.diag(right[1]), floor))
    sizes = np.outer(sigma, sigma)
    spread = max(np.abs((b[0] - right[0]) / sigma).max() for b in blurred)
    spread_of_cov = max(np.abs((b[1] - right[1]) / sizes).max() for b in blurred)
    if not 300 * max(spread, spread_of_cov) <= 0.1:
        return None
    error = np.abs((mean - right[0]) / sigma).max()
    error_of_cov = np.abs((cov - right[1]) / sizes).max()
    if not error <= good + 300 * spread:
        return f"mean off by {error:.2g} sigma (rounding: {spread:.1g})"
    if not error_of_cov <= good + 300 * spread_of_cov:
        return f"cov off by {error_of_cov:.2g} (rounding: {spread_of_cov:.1g})"
    return ""


def rows_with_an_answer(given: Problem, trace: ej.Trace) -> int:
    """How many rows come before one that measures exactly what is known exactly: from there on
    rounding decides."""
    used = np.isin(np.asarray(trace.info.status), (Status.USED, Status.LATE_USED))
    times = np.asarray(given.stream.time, float)
    for k in np.flatnonzero(used):
        rows = np.flatnonzero(used[: k + 1])
        if filtered(given, rows, times[rows].max()).singular:
            return int(k)
    return len(times)


def same(a: Any, b: Any, where: str) -> str:
    """What differs between two traces by more than rounding."""
    if (np.asarray(a.info.status) != np.asarray(b.info.status)).any():
        return f"{where}: statuses {a.info.status} and {b.info.status}"
    left, right = np.asarray(a.mean), np.asarray(b.mean)
    size = np.sqrt(np.maximum(np.diagonal(np.asarray(b.cov), axis1=1, axis2=2), 0))
    tiny = 1e-9 if left.dtype == np.float64 else 1e-3
    allowed = tiny * size + tiny * 1e-2 * (1 + np.abs(right))
    with np.errstate(invalid="ignore"):
        off = ~((np.abs(left - right) <= allowed) | (np.isnan(left) & np.isnan(right)))
    return (
        f"{where}: row {np.argwhere(off)[0][0]} differs by {np.nanmax(np.abs(left - right)):.2g}"
        if off.any()
        else ""
    )
