"""Sensors that bend what they see: the textbook extended and unscented filters in NumPy."""

from typing import Any

import numpy as np
from oracles.unscented import unscented_moments

import ewif_jax as ej
from ewif_jax import Status
from faults.attack_judge import off_by
from faults.attack_worlds import Problem, bend, motion, noise, push


def against_oracle(name: str, given: Problem, trace: ej.Trace) -> tuple[int, str]:
    """How many rows were compared, and what is wrong with the first that is."""
    if name not in ("extended", "unscented"):
        return 0, ""
    used = np.asarray(trace.info.status) == Status.USED
    eps = float(np.finfo(given.stream.time.dtype).eps)
    rng, rows = np.random.default_rng(2), np.flatnonzero(used)
    try:
        right = filtered(name, given, rows)
        blurred = [filtered(name, given, rows, (rng, eps)) for _ in range(4)]
    except np.linalg.LinAlgError:  # a covariance of which the oracle has no root
        return 0, ""
    for place, row in enumerate(rows):
        moments = [b[place] for b in blurred]
        wrong = off_by(trace.mean[row], trace.cov[row], right[place], moments, eps)
        if wrong is None:
            return place, ""  # beyond this rounding decides
        if wrong:
            return place, f"{wrong} at {row}"
    return len(rows), ""


def filtered(name: str, given: Problem, rows: Any, blur: Any = None) -> list[Any]:
    """Mean and covariance after each row; with `blur` as in `attack_worlds.filtered`."""
    p = {k: np.asarray(v, float if k != "dead" else bool) for k, v in given.params.items()}
    x, P = (np.asarray(v, float) for v in given.prior)
    now, found = 0.0, []

    def off(a: Any) -> Any:
        return a if blur is None else a * (1 + blur[1] * blur[0].uniform(-1, 1, np.shape(a)))

    for k in rows:
        time, s = float(given.stream.time[k]), given.stream.sensor[k]
        F, seen = off(motion(np, p, time - now)), np.asarray(given.stream.mask[k])
        x, P, now = F @ x + push(np, p, time - now), F @ P @ F.T + noise(np, p, time - now), time
        H, R = off(p["H"][s][seen]), p["R"][s][np.ix_(seen, seen)]
        if name == "extended":
            y, slope = bend(np, H @ x), H * (1 + 0.8 * np.cos(H @ x))[:, None]
            S, cross = slope @ P @ slope.T + R, P @ slope.T
        else:
            y, spread, cross = unscented_moments(
                lambda v, H=H: bend(np, H @ v), x, (P + P.T) / 2, 1.0, 0.0, 0.0
            )
            S = spread + R
        size = np.sqrt(np.diag(S))
        if np.linalg.eigvalsh(S / np.outer(size, size)).min() < 1e-9:
            raise np.linalg.LinAlgError("a singular innovation covariance")
        K = np.linalg.solve(S, cross.T).T
        x = off(x + K @ (np.asarray(given.stream.value, float)[k][seen] - y))
        P = P - K @ S @ K.T
        found.append((x, P))
    return found
