"""A seeded attack: random models and streams against every estimator and every entry.

Every outcome is one of: right by an oracle (the NumPy Kalman filter of `attack_worlds`), right by
the invariants, refused by the name of an argument. Anything else is listed with its seed, and the
exit status is 1.

usage: PYTHONPATH=tests python tests/faults/attack.py [--full] [--only NAME ...] [--seeds A:B]
"""

import argparse
import collections
import faulthandler
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script it finds its neighbours

from contracts.registry import ROWS, Row

import ewif_jax as ej
from ewif_jax import Status
from faults import attack_entries
from faults.attack_judge import (
    MAY_FORGET,
    against_oracle,
    broken_invariant,
    rows_with_an_answer,
    same,
)
from faults.attack_worlds import Problem, bent_world, linear_world, problem
from faults.named import is_named

STEPS, RUNS = 12, 3
SMALL, SHAPES = (3, 2, 2), ((1, 1, 1), (2, 1, 2), (3, 2, 2), (4, 2, 3), (8, 4, 3))
"""(states, components, sensors)."""
BACKWARD = MAY_FORGET | {"b1", "bl1", "pf_extended"}
"""Whose docstrings ask for motion that can be turned round: they get no dead modes."""
CI = ("kalman", "al1", "replay")


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
    except Exception as error:
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
    stacked = jax.tree.map(
        lambda *x: np.stack(x), *[(p.params, p.stream, p.prior) for p in problems]
    )
    try:
        alone = [
            ej.run(
                estimator,
                p.params,
                p.stream,
                prior=p.prior,
                t0=0.0,
                key=None if keys is None else keys[k],
            )
            for k, p in enumerate(problems)
        ]
        batch = ej.run_batch(
            estimator,
            stacked[0],
            stacked[1],
            prior=stacked[2],
            t0=0.0,
            params_per_run=True,
            key=keys,
        )
    except (ValueError, TypeError) as error:
        return refusal(error)
    for k, p in enumerate(problems):
        rows = rows_with_an_answer(p, alone[k])
        alone[k] = first_rows(alone[k], rows)
        one = jax.tree.map(lambda x, k=k: x[k], batch._replace(final_state=None))
        one = first_rows(one, rows)
        wrong = same(one, alone[k], f"run_batch is not run (run {k})")
        if not wrong and name == "ewif":
            parallel = ej.run_parallel(
                linear_world_of_ewif(), p.params, p.stream, tau=by_tau, prior=p.prior, t0=0.0
            )
            wrong = same(first_rows(parallel, rows), alone[k], "run_parallel is not run")
        if not wrong and k == 0:
            stepped = at_used(first_rows(by_steps(name, p, keys), rows))
            wrong = same(stepped, at_used(alone[k]), "step is not run")
        if wrong:
            return Outcome("WRONG", wrong)
    return Outcome("entries agree")


def first_rows(trace: ej.Trace, count: int) -> ej.Trace:
    return jax.tree.map(lambda x: np.asarray(x)[:count], trace._replace(final_state=None))


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
    return ej.Trace(given.stream.time, mean, cov, info, None)


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


def plan(
    full: bool, only: list[str], seeds: range | None
) -> Iterator[tuple[str, Callable[[], Outcome]]]:
    """(label, what to try) of every input."""
    names = only or ([row.name for row in ROWS] if full else list(CI))
    jobs: list[tuple[str, Any, tuple]] = []
    for name in (n for n in names if n != "entries"):
        heavy = row_of(name).needs_key
        shapes = (SHAPES[:3] if heavy else SHAPES) if full else (SMALL,)
        for shape in shapes:
            count = (40 if heavy else 60) if full else 25
            jobs += [
                (name, attack_values, (name, s, shape, np.float64)) for s in seeds or range(count)
            ]
        if full:
            some = seeds or range(40)
            jobs += [(name, attack_values, (name, s, SMALL, np.float32)) for s in some]
            jobs += [(name, attack_entries_agree, (name, s, SMALL)) for s in list(some)[:10]]
            if row_of(name).differentiable:
                jobs += [(name, attack_loss, (name, s, SMALL)) for s in list(some)[:20]]
            if name in {"extended", "unscented", "rts_reference", "al1", "asd"} or heavy:
                jobs += [
                    (name, attack_values, (name, s, SMALL, np.float64, True))
                    for s in list(some)[:20]
                ]
    for name, attempt, arguments in jobs:
        yield name, lambda attempt=attempt, arguments=arguments: attempt(*arguments)
    if not only or "entries" in only:
        count = 1500 if full else 120
        for seed in seeds or range(count):
            yield "entries", lambda seed=seed: Outcome(*attack_entries.attempt(seed))


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
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
