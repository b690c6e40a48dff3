"""Ensembles and particles against a NumPy Kalman filter, within the error that drawing makes."""

from functools import cache
from typing import Any

import jax
import numpy as np

import ewif_jax as ej
from ewif_jax import Status
from faults.attack_judge import broken_invariant
from faults.attack_worlds import Problem, filtered, linear_world

KEYS, MEMBERS = 6, 2000
LAG = 4
BUILD = {
    "ensemble": lambda m: ej.ensemble(m, MEMBERS),
    "ensemble_square_root": lambda m: ej.ensemble(m, MEMBERS, "square_root"),
    "enkf1": lambda m: ej.enkf1(m, MEMBERS, LAG),
    "enkf2": lambda m: ej.enkf2(m, MEMBERS, LAG),
    "bootstrap": lambda m: ej.bootstrap(m, MEMBERS),
    "pf_retrodict": lambda m: ej.pf_retrodict(m, MEMBERS),
}
PARTICLES = {"bootstrap", "pf_retrodict"}


@cache
def built(name: str) -> ej.Estimator:
    return BUILD[name](linear_world())


def run_with_keys(name: str, given: Problem, seed: int) -> ej.Trace:
    """One problem with several keys."""
    stream = given.stream._replace(value=np.stack([given.stream.value] * KEYS))
    keys = jax.random.split(jax.random.key(seed), KEYS)
    trace = ej.run_batch(built(name), given.params, stream, prior=given.prior, t0=0.0, key=keys)
    return jax.tree.map(np.asarray, trace._replace(final_state=None))


def against_oracle(name: str, given: Problem, trace: ej.Trace) -> tuple[int, str]:
    """How many rows were compared, and what is wrong.

    The keys differ by what drawing makes; their average may be off by a few of its own errors, and
    by what a finite number of members is biased by.
    """
    for key in range(KEYS):
        wrong = broken_invariant(name, given, jax.tree.map(lambda x, k=key: x[k], trace))
        if wrong:
            return 0, f"{wrong} (key {key})"
    status, times = trace.info.status[0], np.asarray(given.stream.time, float)
    if (status == Status.LATE_USED).any() or (trace.info.status != status).any():
        return 0, ""  # late updates of these filters are approximations
    compared, rows = 0, np.flatnonzero(status == Status.USED)
    for place, row in enumerate(rows):
        right = filtered(given, rows[: place + 1], times[row])
        if right.singular or (name in PARTICLES and _starved(given, rows[: place + 1])):
            break
        variances = np.diag(right.cov)
        if (variances <= 1e-9 * (1 + right.mean**2)).any():
            break  # next to rounding
        sigma, means = np.sqrt(variances), trace.mean[:, row]
        error = np.abs(means.mean(0) - right.mean) / sigma
        allowed = 6 * means.std(0, ddof=1) / sigma / np.sqrt(KEYS) + 0.15
        if (error > allowed).any():
            return compared, f"mean off by {error.max():.2g} sigma at {row} ({allowed.max():.2g})"
        found = np.diagonal(trace.cov[:, row], axis1=1, axis2=2)
        ratio, spread = found.mean(0) / variances, found.std(0, ddof=1) / variances
        room = 6 * spread / np.sqrt(KEYS) + 0.25
        if (np.abs(ratio - 1) > room).any():
            return compared, f"variances {ratio} of the right ones at {row}"
        compared += 1
    return compared, ""


def _starved(given: Problem, rows: Any) -> bool:
    """Whether the newest measurement leaves few particles any weight."""
    k = rows[-1]
    before = filtered(given, rows[:-1], float(given.stream.time[k]))
    after = filtered(given, rows, float(given.stream.time[k]))
    share = np.linalg.det(after.cov) / max(np.linalg.det(before.cov), 1e-300)
    far = (after.mean - before.mean) / np.sqrt(np.maximum(np.diag(before.cov), 1e-300))
    return bool(np.sqrt(share) < 0.05 or np.abs(far).max() > 2.5 or before.singular)
