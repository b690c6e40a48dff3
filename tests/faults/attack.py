"""A seeded attack: random models and streams against every estimator and every entry.

Every outcome is one of: right by an oracle (the NumPy Kalman filter of `attack_worlds`), right by
the invariants, refused by the name of an argument. Anything else is listed with its seed, and the
exit status is 1.

usage: PYTHONPATH=tests python tests/faults/attack.py [--full] [--only NAME ...] [--seeds A:B]
"""

import argparse
import collections
import faulthandler
import math
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import ewif_jax as ej
from contracts.registry import ROWS, Row
from ewif_jax import Status
from faults import attack_entries
from faults.attack_worlds import Problem, bent_world, filtered, linear_world, problem
from faults.named import is_named

STEPS, RUNS = 12, 3
SMALL, SHAPES = (3, 2, 2), ((1, 1, 1), (2, 1, 2), (3, 2, 2), (4, 2, 3), (8, 4, 3))
"""(states, components, sensors)."""
IN_ORDER = {"kalman", "square_root", "information", "extended", "unscented"}
EXACT_LATE = {"replay", "rts_reference", "asd"}
ONE_STEP = {"a1", "b1", "al1", "bl1", "selective"}
WEIGHTED = {"ewif", "drop_late"}
BACKWARD = WEIGHTED | {"limited_memory", "fixed_lag_ewif", "b1", "bl1", "pf_extended"}
"""Whose docstrings ask for motion that can be turned round: they get no dead modes."""
CI = ("kalman", "square_root", "ewif", "al1", "replay")


class Outcome(NamedTuple):
    """kind: a column of the table; what: of a fault, what is wrong."""

    kind: str
    what: str = ""


@cache
def built(name: str, bent: bool) -> ej.Estimator:
    return row_of(name).build(bent_world() if bent else linear_world())


def row_of(name: str) -> Row:
    return next(row for row in ROWS if row.name == name)


def drawn(name: str, seed: int, shape: tuple[int, int, int], dtype: Any) -> Problem:
    given = problem(seed, *shape, STEPS, dtype)
    if name in BACKWARD or name.startswith("pf"):
        given.params["dead"] = np.zeros_like(given.params["dead"])
        given.traits["dead"] = "none"
    return given


def entry(name: str, seed: int) -> dict[str, Any]:
    return {"key": jax.random.key(seed)} if row_of(name).needs_key else {}


def attack_values(
    name: str, seed: int, shape: tuple[int, int, int], dtype: Any, bent: bool = False
) -> Outcome:
    """What `run` makes of the problem of a seed."""
    estimator, given = built(name, bent), drawn(name, seed, shape, dtype)
    try:
        trace = ej.run(
            estimator, given.params, given.stream, prior=given.prior, t0=0.0, **entry(name, seed)
        )
    except (ValueError, TypeError) as error:
        return refusal(error)
    except Exception as error:  # noqa: BLE001 - the attack reports whatever comes
        return Outcome("OBSCURE", f"{type(error).__name__}: {str(error)[:120]}")
    trace = jax.tree.map(np.asarray, trace._replace(final_state=None))
    wrong = broken_invariant(name, given, trace)
    if wrong:
        return Outcome("WRONG", wrong)
    if bent:
        return Outcome("right by invariants")
    compared, wrong = against_oracle(name, given, trace)
    if wrong:
        return Outcome("WRONG", wrong)
    return Outcome("right by the oracle" if compared else "right by invariants")


def refusal(error: Exception) -> Outcome:
    text = str(error)
    if is_named(text):
        return Outcome("refused by name")
    return Outcome("OBSCURE", f"{type(error).__name__}: {text[:120]}")


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
    if (info.innovation[unseen] != 0).any() or (info.innovation_cov[unseen] != np.eye(info.innovation.shape[1])).any():
        return "innovation of a row that is TOO_LATE or MASKED"
    variances = np.diagonal(trace.cov, axis1=1, axis2=2)
    if (variances < 0).any():
        return f"negative variance {variances.min():.2g}, status {status[np.argwhere(variances < 0)[0][0]]}"
    defined = np.isfinite(trace.mean).all(1) & np.isfinite(trace.cov).all((1, 2))
    if (used & ~defined).any() and name not in WEIGHTED | {"limited_memory", "fixed_lag_ewif"}:
        return f"NaN with status USED at {np.flatnonzero(used & ~defined)[0]}"
    if np.isnan(info.log_likelihood).any() or np.isnan(info.innovation).any():
        return "NaN in Info"
    size = np.sqrt(np.maximum(variances, np.finfo(time.dtype).tiny))
    scaled = np.where(defined[:, None, None], trace.cov, 0) / (size[:, :, None] * size[:, None, :])
    if np.abs(scaled - scaled.swapaxes(1, 2)).max() > 1e-6:
        return "a covariance that is not symmetric"
    still = (trace.time[1:] == trace.time[:-1]) & ~used[1:] & defined[:-1]
    if (still & (np.abs(trace.mean[1:] - trace.mean[:-1]) > 0).any(1)).any():
        return "a row that is not used moved the estimate"
    return ""


def against_oracle(name: str, given: Problem, trace: ej.Trace) -> tuple[int, str]:
    """How many rows were compared, and what is wrong with the first that is."""
    used = np.isin(trace.info.status, (Status.USED, Status.LATE_USED))
    times, eps = np.asarray(given.stream.time, float), float(np.finfo(given.stream.time.dtype).eps)
    any_late = (trace.info.status == Status.LATE_USED).any()
    known = name in IN_ORDER | EXACT_LATE | WEIGHTED | {"fading"}
    if not known and (name not in ONE_STEP or any_late):
        return 0, ""
    noisy = name not in WEIGHTED
    inflate = None
    if name == "fading":
        inflate = lambda dt: float(given.params["fading"]) ** 2 if dt > 0 else 1.0  # noqa: E731
    if name in WEIGHTED:
        inflate = lambda dt: math.exp(dt / float(given.params["tau"]))  # noqa: E731
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
        floor = (eps * 1e2 * (1 + np.abs(right.mean).max())) ** 2
        sigma = np.sqrt(np.maximum(np.diag(right.cov), floor))
        spread = max(np.abs((b.mean - right.mean) / sigma).max() for b in blurred)
        spread_of_cov = max(np.abs((b.cov - right.cov) / np.outer(sigma, sigma)).max() for b in blurred)
        if 300 * max(spread, spread_of_cov) > 0.1:
            break  # beyond this rounding decides
        if not used[k]:
            if np.abs(given.stream.value[k]).max() > 1e15:
                continue
            return compared, f"REJECTED without a reason at {k}"
        error = np.abs((trace.mean[k] - right.mean) / sigma).max()
        error_of_cov = np.abs((trace.cov[k] - right.cov) / np.outer(sigma, sigma)).max()
        if not error <= good + 300 * spread:
            return compared, f"mean off by {error:.2g} sigma at {k} (rounding: {spread:.1g})"
        if not error_of_cov <= good + 300 * spread_of_cov:
            return compared, f"cov off by {error_of_cov:.2g} at {k} (rounding: {spread_of_cov:.1g})"
        compared += 1
    return compared, ""


def same(a: Any, b: Any, where: str, sigma: Any = None) -> str:
    """What differs between two traces by more than rounding."""
    if (np.asarray(a.info.status) != np.asarray(b.info.status)).any():
        return f"{where}: statuses {a.info.status} and {b.info.status}"
    left, right = np.asarray(a.mean), np.asarray(b.mean)
    size = np.sqrt(np.maximum(np.diagonal(np.asarray(b.cov), axis1=1, axis2=2), 0))
    tiny = 1e-9 if left.dtype == np.float64 else 1e-3
    allowed = tiny * size + tiny * 1e-2 * (1 + np.abs(right))
    with np.errstate(invalid="ignore"):
        off = ~((np.abs(left - right) <= allowed) | (np.isnan(left) & np.isnan(right)))
    return f"{where}: row {np.argwhere(off)[0][0]} differs by {np.nanmax(np.abs(left - right)):.2g}" if off.any() else ""


@cache
def stepper(name: str, bent: bool) -> Callable[..., Any]:
    estimator = built(name, bent)

    def stepped(params: Any, state: Any, z: Any) -> Any:
        state, info = ej.step(estimator, params, state, z)
        return state, (estimator.estimate(params, state), info)

    return jax.jit(stepped)


def attack_entries_agree(name: str, seed: int, shape: tuple[int, int, int]) -> Outcome:
    """`run`, `step`, `run_batch` (and for `ewif` `run_parallel`) on three problems."""
    estimator = built(name, False)
    problems = [drawn(name, seed * RUNS + k, shape, np.float64) for k in range(RUNS)]
    keys = jax.random.split(jax.random.key(seed), RUNS) if row_of(name).needs_key else None
    stacked = jax.tree.map(lambda *x: np.stack(x), *[(p.params, p.stream, p.prior) for p in problems])
    try:
        alone = [
            ej.run(estimator, p.params, p.stream, prior=p.prior, t0=0.0, key=None if keys is None else keys[k])
            for k, p in enumerate(problems)
        ]
        batch = ej.run_batch(
            estimator, stacked[0], stacked[1], prior=stacked[2], t0=0.0, params_per_run=True, key=keys
        )
    except (ValueError, TypeError) as error:
        return refusal(error)
    for k, p in enumerate(problems):
        one = jax.tree.map(lambda x, k=k: x[k], batch._replace(final_state=None))
        wrong = same(one, alone[k], f"run_batch is not run (run {k})")
        if not wrong and name == "ewif":
            parallel = ej.run_parallel(
                linear_world_of_ewif(), p.params, p.stream, tau=by_tau, prior=p.prior, t0=0.0
            )
            wrong = same(parallel, alone[k], "run_parallel is not run")
        if not wrong and k == 0:
            wrong = same(by_steps(name, p, keys), at_used(alone[k]), "step is not run")
        if wrong:
            return Outcome("WRONG", wrong)
    return Outcome("entries agree")


def by_tau(params: Any) -> Any:
    return params["tau"]


@cache
def linear_world_of_ewif() -> ej.Model:
    return linear_world()


def by_steps(name: str, given: Problem, keys: Any) -> ej.Trace:
    estimator, stepped = built(name, False), stepper(name, False)
    prior = ej.Gaussian(*map(jnp.asarray, given.prior))
    state = estimator.init(given.params, prior, jnp.asarray(0.0), None if keys is None else keys[0])
    out = []
    for k in range(STEPS):
        state, seen = stepped(given.params, state, jax.tree.map(lambda x, k=k: x[k], given.stream))
        out.append(seen)
    (mean, cov), info = jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *out)
    return at_used(ej.Trace(given.stream.time, mean, cov, info, None))


def at_used(trace: ej.Trace) -> ej.Trace:
    """The rows that are not masked: a masked one is reported at its own time by `run` alone."""
    seen = np.asarray(trace.info.status) != Status.MASKED
    return jax.tree.map(lambda x: np.asarray(x)[seen], trace._replace(final_state=None))


@cache
def slope(name: str) -> Callable[..., Any]:
    estimator, tuned = built(name, False), ("density", "R", "rate", "tau")

    def loss(own: Any, params: Any, stream: Any, prior: Any, key: Any) -> Any:
        setting = {"prior": prior, "t0": 0.0, "key": key}
        return ej.likelihood_loss(estimator, stream, **setting)({**params, **own})

    def valued(params: Any, stream: Any, prior: Any, key: Any) -> Any:
        own = {k: params[k] for k in tuned}
        return jax.value_and_grad(loss)(own, params, stream, prior, key)

    return jax.jit(valued)


def attack_loss(name: str, seed: int, shape: tuple[int, int, int]) -> Outcome:
    """The likelihood loss and its slope are numbers, or the loss is +inf."""
    given = drawn(name, seed, shape, np.float64)
    key = entry(name, seed).get("key")
    try:
        value, slopes = slope(name)(given.params, given.stream, given.prior, key)
    except (ValueError, TypeError) as error:
        return refusal(error)
    if np.isnan(value) or value == -np.inf:
        return Outcome("WRONG", f"likelihood loss {value}")
    bad = [k for k, x in slopes.items() if not np.isfinite(x).all()]
    if bad:
        return Outcome("WRONG", f"gradient not finite in {bad}, loss {value:.3g}")
    return Outcome("loss and slope finite")


def plan(full: bool, only: list[str], seeds: range | None) -> Iterator[tuple[str, Callable[[], Outcome]]]:
    """(label, what to try) of every input."""
    names = only or ([row.name for row in ROWS] if full else list(CI))
    jobs: list[tuple[str, Any, tuple]] = []
    for name in (n for n in names if n != "entries"):
        heavy = row_of(name).needs_key
        shapes = (SHAPES[:3] if heavy else SHAPES) if full else (SMALL,)
        for shape in shapes:
            count = (40 if heavy else 60) if full else 25
            jobs += [(name, attack_values, (name, s, shape, np.float64)) for s in seeds or range(count)]
        if full:
            some = seeds or range(40)
            jobs += [(name, attack_values, (name, s, SMALL, np.float32)) for s in some]
            jobs += [(name, attack_entries_agree, (name, s, SMALL)) for s in list(some)[:10]]
            if row_of(name).differentiable:
                jobs += [(name, attack_loss, (name, s, SMALL)) for s in list(some)[:20]]
            if name in {"extended", "unscented", "rts_reference", "al1", "asd"} or heavy:
                jobs += [(name, attack_values, (name, s, SMALL, np.float64, True)) for s in list(some)[:20]]
    for name, attempt, arguments in jobs:
        yield name, lambda attempt=attempt, arguments=arguments: attempt(*arguments)
    if not only or "entries" in only:
        count = 1500 if full else 120
        for seed in seeds or range(count):
            yield "entries", lambda seed=seed: Outcome(*attack_entries.attempt(seed))


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--full", action="store_true", help="10,000 inputs, every estimator")
    parser.add_argument("--only", nargs="*", default=[], help="names of estimators, or `entries`")
    parser.add_argument("--seeds", default="", help="A:B")
    given = parser.parse_args(arguments)
    seeds = range(*map(int, given.seeds.split(":"))) if given.seeds else None
    table: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
    faults = []
    for count, (label, attempt) in enumerate(plan(given.full, given.only, seeds)):
        faulthandler.dump_traceback_later(300, exit=True)  # a hang says where, and ends
        if count % 400 == 399:
            jax.clear_caches() if given.full else None
        outcome = attempt()
        table[label][outcome.kind] += 1
        if outcome.kind.isupper():
            where = attempt.__defaults__
            faults.append(f"{label}: {outcome.kind} {outcome.what}  {where}")
            print(faults[-1], flush=True)
    faulthandler.cancel_dump_traceback_later()
    kinds = sorted({kind for row in table.values() for kind in row})
    print("\n" + " | ".join(["estimator", *kinds]))
    for label, row in table.items():
        print(" | ".join([label, *(str(row[kind]) for kind in kinds)]))
    total = sum(sum(row.values()) for row in table.values())
    print(f"{total} inputs, {len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    sys.exit(main(sys.argv[1:]))
