"""A study in one call: methods, on the same runs of a scenario, over a grid of its parameters."""

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ewif_jax.lab import hosts
from ewif_jax.lab.comparison import Comparison
from ewif_jax.lab.design import Design, Limits, designed
from ewif_jax.lab.engine import Unit, compute_unit, compute_units, not_there
from ewif_jax.lab.identity import digest_of, source_fingerprint
from ewif_jax.lab.methods import Method
from ewif_jax.lab.moments import PairedMoments, combined_pairs, means, paired_moments
from ewif_jax.lab.progress import Progress
from ewif_jax.lab.store import InFolder, InMemory, Store
from ewif_jax.lab.tuned import tuned_params
from ewif_jax.monte_carlo import Scenario
from ewif_jax.scores import Score
from ewif_jax.types import Estimator, PyTree, RandomKey

LEAST_RUNS = 20
"""before which a standard error is not believed"""


def compare(
    methods: Mapping[str, Estimator | Method],
    scenario: Scenario,
    *,
    over: Mapping[str, Sequence[float]] | None = None,
    runs: int | str = 1000,
    key: RandomKey = None,
    metrics: Mapping[str, Score] | None = None,
    limits: Mapping[str, Limits] | None = None,
    time: bool = False,
    warm_up: float | None = None,
    folder: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
    devices: int | None = None,
    chunk: int | None = None,
    most_runs: int | None = None,
    progress: bool | Callable[[int, int], None] = False,
) -> Comparison:
    r"""A `Comparison` of methods that filter the same simulated runs, at every point of a grid.

    Run i at a point is simulated once, from `fold_in(key, i)` and the numbers of the point, and
    filtered by every method (common random numbers). A chunk of runs at a point is a unit of work:
    one program on one device, so its numbers are the same bits whatever the other methods, devices
    and executor are. The numbers of an axis are arguments of programs: more of them compile
    nothing again.

    **The same rows for all.** Every method is scored in every row of a run. Where it has no
    estimate (`prior=None` at the start, information gone), what the scenario's prior says stands
    in for it, and the table counts such rows (`without`). If the scenario has no prior, the rows
    before the data can determine a state (counted, not judged by numbers) count for nobody.
    `warm_up` says instead from when on rows count.

    Args:
        methods: by name: an `Estimator`, or a `Method` with parameters of its own.
        scenario: where the runs come from; simulate(key, params) reads the axes from `params`.
        over: numbers by axis. An axis is a parameter of the scenario, or of the methods that ask
            for it by `axis(name)`. Default: one point.
        runs: how many at each point, or "until 1 %": chunks are added until the standard error of
            every method and metric is at most that part of it.
        key: PRNG key.
        metrics: scores by name (`ewif_jax.scores`); default {"squared_error": squared_error}. A
            table shows the root of the mean of a squared error.
        limits: `Limits` by metric: time to converge, share of lost runs.
        time: whether to keep the averages over runs of each step too.
        warm_up: seconds from t0 in which rows count for nobody.
        folder: where results are kept, chunk by chunk. The same call goes on where an earlier one
            was stopped, however it was.
        executor: of the interface `concurrent.futures.Executor` (processes, Dask's
            `Client.get_executor()`); default: the local devices. Where `jax.distributed` has
            several processes, they all make the same call and share the work instead.
        devices: how many local devices, at most.
        chunk: runs in a unit of work; default: all if they are at most 1024 and a million arrivals
            together, else equal parts.
        most_runs: where `runs` says until when (default a million).
        progress: True (lines on standard error), or a function (units done, units).

    Raises:
        ValueError: what is wrong with an argument, by name; a folder that another study, other
            code or another program has made.
        RuntimeError: another process fills the folder.
        OSError: the folder cannot be written to, or has no room; with its path.

    Reduces to: `monte_carlo` of each method at each point, where every method has a prior.
    """
    design = designed(
        methods, scenario, over, metrics, limits, runs, most_runs, chunk, key, time, warm_up
    )
    about = _about_design(design)
    # Of several processes of one program the first keeps the folder.
    if folder is None or not hosts.is_first():
        return _filled_store(design, InMemory(), executor, devices, progress, about)
    store = InFolder(folder, about)
    store.claim(_bytes_needed(design))
    try:
        return _filled_store(design, store, executor, devices, progress, about)
    finally:
        store.leave()


def _filled_store(
    design: Design,
    store: Store,
    executor: Executor | None,
    devices: int | None,
    progress: bool | Callable[[int, int], None],
    about: Mapping[str, Any],
) -> Comparison:
    report = Progress(progress, "compare")
    tuned = tuned_params(design, store, report)
    points = range(len(design.points))
    if design.until is None:
        units = [Unit(p, c) for p in points for c in range(design.chunks)]
        _compute_all(design, tuned, units, store, executor, devices, report)
        chunks = [design.chunks] * len(points)
    else:
        chunks = _until_enough(design, tuned, store, executor, devices, report)
    return Comparison(design, store, tuple(chunks), tuned, dict(about))


def _compute_all(
    design: Design,
    tuned: PyTree,
    units: Sequence[Unit],
    store: Store,
    executor: Executor | None,
    devices: int | None,
    report: Progress,
) -> None:
    left = not_there(store, units)
    finished = len(units) - len(left)
    report.start(finished, len(units))

    def keep(unit: Unit, arrays: Mapping[str, Any]) -> None:
        nonlocal finished
        store.write(unit.name, arrays)
        finished += 1
        report.step(finished, len(units))

    if hosts.are_several():
        hosts.share_units(units, store, lambda unit: compute_unit(design, tuned, unit), keep)
        return
    compute_units(design, tuned, left, keep, executor, devices)


def _until_enough(
    design: Design,
    tuned: PyTree,
    store: Store,
    executor: Executor | None,
    devices: int | None,
    report: Progress,
) -> list[int]:
    """How many chunks each point took. A chunk at a time goes to every point that needs more, so
    the number does not depend on who computes."""
    chunks = [0] * len(design.points)
    found: list[dict[str, PairedMoments]] = [{} for _ in chunks]
    going = list(range(len(chunks)))
    while going:
        units = [Unit(p, chunks[p]) for p in going]
        _compute_all(design, tuned, units, store, executor, devices, report)
        for unit in units:
            arrays = store.read(unit.name)
            chunks[unit.point] += 1
            for name in design.metrics:
                added = paired_moments(arrays[f"score/{name}"])
                earlier = found[unit.point].get(name)
                found[unit.point][name] = (
                    added if earlier is None else combined_pairs(earlier, added)
                )
        going = [
            p for p in going if chunks[p] < design.chunks and not _precise_enough(design, found[p])
        ]
    return chunks


def _precise_enough(design: Design, found: Mapping[str, PairedMoments]) -> bool:
    """Whether all standard errors are small enough; what has none never will."""
    assert design.until is not None
    for name, moments in found.items():
        if np.diag(moments.count).max() < LEAST_RUNS:
            return False
        value, error = means(moments, name in design.roots)
        if np.any(error > design.until * np.abs(value)):
            return False
    return True


def _about_design(design: Design) -> dict[str, Any]:
    """What decides the numbers, in words that a refusal can show."""
    key = design.key
    return {
        "methods": {name: digest_of(method) for name, method in design.methods.items()},
        "scenario": digest_of(design.scenario),
        "over": {name: list(values) for name, values in design.axes.items()},
        "metrics": {name: digest_of(score) for name, score in design.metrics.items()},
        "limits": {name: list(limits) for name, limits in design.limits.items()},
        "runs": design.runs if design.until is None else f"until {100 * design.until:g} %",
        "most runs": design.runs,
        "chunk": design.chunk,
        "key": digest_of(key),
        "time": design.over_time,
        "warm up": design.warm_up,
        "dtype": str(jnp.asarray(0.0).dtype),
        "processor": f"{jax.default_backend()} {platform.machine()}",
        "version": f"ewif_jax {version('ewif_jax')} {source_fingerprint()}, jax {jax.__version__}",
    }


def _bytes_needed(design: Design) -> int:
    """Of all results at most."""
    methods, metrics = len(design.methods), len(design.metrics)
    runwise = 8 * methods * (2 * metrics + 2 * len(design.limits)) + 8
    steps = 8 * design.steps * (1 + 3 * methods * metrics * design.over_time)
    if design.until is not None:
        return len(design.points) * (runwise * design.chunk + steps + 8192)
    units = len(design.points) * design.chunks
    return len(design.points) * design.runs * runwise + units * (steps + 8192)
