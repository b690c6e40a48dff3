"""What is tried with a filter of the registry on a problem that was drawn."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from contracts.registry import ROWS, Row

import ewif_jax as ej
from ewif_jax import Status
from faults import attack_bent, attack_drawn, attack_smoothers
from faults.attack_judge import (
    MAY_FORGET,
    against_oracle,
    broken_invariant,
    expected_density,
    rows_with_an_answer,
    same,
)
from faults.attack_worlds import Problem, bent_world, linear_world, problem
from faults.named import is_named

STEPS, RUNS = 12, 3
BACKWARD = MAY_FORGET | {"b1", "bl1", "pf_extended", "batch_wls", "two_sided_ewif"}
"""Whose docstrings ask for motion that can be turned round: they get no dead modes."""
INVERTS_R = MAY_FORGET | {"batch_wls", "two_sided_ewif"}
"""That refuse an exact measurement. What is drawn as a "zero" or "singular" R is one, and so is an
"exact part"."""


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
    except Exception as error:  # nothing is passed over: it is a fault unless it is a good reason
        return refusal(name, given, error)
    trace = jax.tree.map(np.asarray, trace._replace(final_state=None))
    wrong = broken_invariant(name, given, trace)
    if wrong:
        return Outcome("WRONG", wrong)
    compared, wrong = compared_with_numpy(name, given, trace, bent)
    if wrong:
        return Outcome("WRONG", wrong)
    return Outcome("right by the oracle" if compared else "right by invariants")


def compared_with_numpy(name: str, given: Problem, trace: ej.Trace, bent: bool) -> tuple[int, str]:
    """How many rows were compared with a NumPy filter, and what is wrong with the first that is."""
    if bent:
        return attack_bent.against_oracle(name, given, trace)
    if name in attack_smoothers.REPORTS:
        return attack_smoothers.judged_reports(name, given, trace)
    return against_oracle(name, given, trace)


def refusal(name: str, given: Problem, error: Exception) -> Outcome:
    """Whether an error names an argument, of which what was drawn is a reason to refuse it."""
    text = str(error)
    if not isinstance(error, ValueError) or not is_named(text):
        return Outcome("OBSCURE", f"{type(error).__name__}: {text[:120]}")
    traits, single = given.traits, given.stream.time.dtype == np.float32
    reasons = {
        "R": name in INVERTS_R and traits["R"] != "full",
        "prior.cov": traits["P"] != "full" or traits["R"] != "full" or single,
        "measurements.time": single or traits["times"] == "duplicates",
    }
    argument = text.split(":")[0].split(" ")[0]
    if not reasons.get(argument):
        return Outcome("WRONG", f"refused without a reason: {text[:120]}")
    return Outcome("refused by name")


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
    except Exception as error:  # as above
        return first_reason(name, problems, error)
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


def first_reason(name: str, problems: list[Problem], error: Exception) -> Outcome:
    """The outcome of a call with several problems, one of which may be a reason to refuse it."""
    outcomes = [refusal(name, p, error) for p in problems]
    return next((x for x in outcomes if not x.kind.isupper()), outcomes[0])


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
    """The likelihood loss is the oracle's where there is one, and its slope is a slope; elsewhere
    both are numbers, or the loss is +inf."""
    given = drawn(name, seed, shape, np.float64)
    key = entry(name, seed).get("key")
    try:
        rest = (given.stream, given.prior, key)
        value, slopes = slope(name)(given.params, *rest)
    except Exception as error:  # as above
        return refusal(name, given, error)
    if np.isnan(value) or value == -np.inf:
        return Outcome("WRONG", f"likelihood loss {value}")
    expected = expected_density(name, given)
    if expected is not None and not abs(-value - expected[0]) <= expected[1]:
        return Outcome("WRONG", f"likelihood loss {value:.6g} for {-expected[0]:.6g}")
    bad = [k for k, x in slopes.items() if not np.isfinite(x).all()]
    if bad:
        return Outcome("WRONG", f"gradient not finite in {bad}, loss {value:.3g}")
    if expected is None or given.traits["R"] != "full":
        return Outcome("loss and slope finite")
    rise = 1e-5
    ends = [
        slope(name)({**given.params, "R": given.params["R"] * (1 + h)}, *rest)[0]
        for h in (-rise, rise)
    ]
    difference, found = (ends[1] - ends[0]) / (2 * rise), np.vdot(slopes["R"], given.params["R"])
    if not abs(difference - found) <= 1e-4 * abs(found) + 1e-5 * (1 + abs(value)):
        return Outcome("WRONG", f"slope {found:.6g} of a loss that rises by {difference:.6g}")
    return Outcome("loss and slope right")


def attack_smoother(name: str, seed: int, shape: tuple[int, int, int], dtype: Any) -> Outcome:
    """A smoother, or least squares over all the data, on the problem of a seed."""
    given = drawn(name, seed, shape, dtype)
    try:
        found = attack_smoothers.smoothed(name, given)
    except Exception as error:  # as above
        return refusal(name, given, error)
    compared, wrong = attack_smoothers.judged(name, given, found)
    if wrong:
        return Outcome("WRONG", wrong)
    return Outcome("right by the oracle" if compared else "no one answer")


def attack_drawn_ones(name: str, seed: int) -> Outcome:
    """An ensemble or a particle filter with many members and several keys."""
    given = drawn(name, seed, (2, 1, 2), np.float64)
    try:
        trace = attack_drawn.run_with_keys(name, given, seed)
    except Exception as error:  # as above
        return refusal(name, given, error)
    compared, wrong = attack_drawn.against_oracle(name, given, trace)
    if wrong:
        return Outcome("WRONG", wrong)
    return Outcome("right by the oracle" if compared else "right by invariants")
