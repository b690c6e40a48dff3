"""Smoothers and least squares against dense NumPy: the joint Gaussian of all times, and one QR."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from oracles import joint_gaussian, wls

import ewif_jax as ej
from ewif_jax import Status
from faults.attack_judge import off_by
from faults.attack_worlds import Problem, integral, linear_world, motion, noise, push

LAG, BEHIND, CAPACITY = 2, 0.5, 8
"""Of the registry: times of `fixed_lag`, seconds of `fixed_lag_ewif`, rows of `limited_memory`."""
REPORTS = {"fixed_lag", "fixed_lag_ewif", "limited_memory"}
ALL_DATA = ("rts", "batch_wls", "two_sided_ewif")


Oracle = Callable[[Any], tuple[np.ndarray, np.ndarray]]
"""Mean and covariance by NumPy, of matrices that a function of them has made inexact."""


class Verdict(NamedTuple):
    """rows that were compared; what is wrong with the first that is."""

    compared: int
    wrong: str


@cache
def world() -> ej.Model:
    return linear_world()


def by_tau(params: Any) -> Any:
    return params["tau"]


def aged(params: Any, t_l: Any, t_k: Any) -> Any:
    """A weight that is no semigroup: near in time counts."""
    return 1 / (1 + jnp.abs(t_k - t_l) / params["tau"])


def smoothed(name: str, given: Problem) -> Any:
    """What the package makes of all the measurements."""
    stream, setting = given.stream, {"prior": given.prior, "t0": 0.0}
    if name == "rts":
        return ej.rts(world(), given.params, stream, **setting)
    if name == "two_sided_ewif":
        return ej.two_sided_ewif(world(), given.params, stream, tau=by_tau, **setting)
    times = np.asarray(stream.time)
    return ej.batch_wls(world(), given.params, stream, times, weight=aged, **setting)


def judged(name: str, given: Problem, found: Any) -> Verdict:
    """Every row of a smoother, with the oracle of its method."""
    mean, cov = (np.asarray(x) for x in found)
    times = np.asarray(given.stream.time, float)
    if mean.dtype != given.stream.time.dtype:
        return Verdict(0, f"dtype {mean.dtype}")
    compared = 0
    for k, time in enumerate(times):
        wrong = compare(oracle_of(name, given, time), mean[k], cov[k], given)
        if wrong:
            return Verdict(compared, f"{wrong} at {k}")
        compared += wrong is not None
    return Verdict(compared, "")


def judged_reports(name: str, given: Problem, trace: ej.Trace) -> Verdict:
    """Filters that report of another time than their newest, or of a window."""
    times = np.asarray(given.stream.time, float)
    status, used, compared, passed = trace.info.status, [], 0, [0.0]
    for k, time in enumerate(times):
        if not np.isin(status[k], (Status.USED, Status.LATE_USED)):
            continue
        used.append(k)
        if time > passed[-1]:
            passed.append(time)
        wrong = compare(reported(name, given, used, passed), trace.mean[k], trace.cov[k], given)
        if wrong:
            return Verdict(compared, f"{wrong} at {k}")
        compared += wrong is not None
    return Verdict(compared, "")


def reported(name: str, given: Problem, used: list[int], passed: list[float]) -> Oracle:
    """What a filter reports that has used these rows, and moved to these times."""
    now = passed[-1]
    if name == "fixed_lag":
        return posterior(given, passed[-1 - LAG] if len(passed) > LAG else 0.0, used)
    if name == "fixed_lag_ewif":
        return least_squares(given, now - BEHIND, wls.ewif_weight(float(given.params["tau"])), used)
    newest = sorted(used, key=lambda row: float(given.stream.time[row]))[-CAPACITY:]
    return least_squares(given, now, wls.window_weight(float(given.params["window"])), newest)


def compare(oracle: Oracle, mean: Any, cov: Any, given: Problem) -> str | None:
    """What is wrong; None where rounding decides."""
    eps = float(np.finfo(given.stream.time.dtype).eps)
    rng = np.random.default_rng(5)
    try:
        right = oracle(lambda a: a)
        blurred = [oracle(lambda a: a * (1 + eps * rng.uniform(-1, 1, np.shape(a)))) for _ in "abc"]
    except np.linalg.LinAlgError:  # the oracle's matrix is singular: there is no one answer
        return None
    return off_by(mean, cov, right, blurred, eps)


def oracle_of(name: str, given: Problem, time: float) -> Oracle:
    if name == "rts":
        return posterior(given, time, range(len(given.stream.time)))
    tau = float(given.params["tau"])
    weight = wls.symmetric_weight(tau)
    if name == "batch_wls":
        weight = lambda t_l, t_k: 1 / (1 + abs(t_k - t_l) / tau)  # noqa: E731
    return least_squares(given, time, weight, range(len(given.stream.time)))


def exact(given: Problem) -> dict[str, Any]:
    return {k: np.asarray(v, bool if k == "dead" else float) for k, v in given.params.items()}


def rows_of(given: Problem, rows: Any) -> dict[str, Any]:
    """The measurements as the oracles take them."""
    p, stream = exact(given), given.stream
    rows = [k for k in rows if np.asarray(stream.mask)[k].any()]
    sensor = np.asarray(stream.sensor)[rows]
    return {
        "times": np.asarray(stream.time, float)[rows],
        "H": p["H"][sensor],
        "R": p["R"][sensor],
        "values": np.asarray(stream.value, float)[rows],
        "masks": np.asarray(stream.mask)[rows],
    }


def posterior(given: Problem, time: float, rows: Any) -> Oracle:
    p, data = exact(given), rows_of(given, rows)

    def found(off: Any) -> tuple[np.ndarray, np.ndarray]:
        return joint_gaussian.posterior(
            time,
            t0=0.0,
            prior_mean=np.asarray(given.prior.mean, float),
            prior_cov=np.asarray(given.prior.cov, float),
            F=lambda a, b: off(motion(np, p, b - a)),
            Q=lambda a, b: symmetric(off(noise(np, p, b - a))),
            b=lambda a, b: off(push(np, p, b - a)),
            **{**data, "H": off(data["H"])},
        )

    return found


def least_squares(given: Problem, time: float, weight: Any, rows: Any) -> Oracle:
    p, data = exact(given), rows_of(given, rows)

    def found(off: Any) -> tuple[np.ndarray, np.ndarray]:
        prior = (*(np.asarray(x, float) for x in given.prior), 0.0)
        return wls.batch_wls(
            time,
            lambda t_l, t: off(motion(np, p, t_l - t)),
            lambda t_l, t: off(p["basis"] @ (p["push"] * integral(np, p["rate"], t_l - t))),
            weight=weight,
            prior=prior,
            **{**data, "H": off(data["H"])},
        )

    return found


def symmetric(a: np.ndarray) -> np.ndarray:
    return (a + a.T) / 2
