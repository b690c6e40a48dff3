"""Orguner & Gustafsson, section IV: particle filters, a fast turn, and a late third sensor."""

from functools import partial
from typing import Any

import jax
import numpy as np
import xarray as xr

from ewif_jax.analysis.storage import storage
from ewif_jax.monte_carlo import Simulation
from ewif_jax.study.papers.turn import figures
from ewif_jax.study.papers.turn import runs as runs_of
from ewif_jax.study.papers.turn.claims import SETTLED, settled_mean, turn_claims
from ewif_jax.study.papers.turn.runs import (
    EKS,
    EXACT,
    LAG,
    TIMES,
    TurnMethod,
)
from ewif_jax.study.shared.claims import ratio
from ewif_jax.study.shared.experiment import Experiment, Measured
from ewif_jax.study.shared.folder import Arrays
from ewif_jax.study.shared.late import mean_of, rmse_of
from ewif_jax.study.shared.late_methods import storage_rows
from ewif_jax.study.shared.one_by_one import seconds_per_run

BLOCK = 200
"""how many runs an interrupted study may have to repeat"""


def run(experiment: Experiment) -> None:
    """Simulates, runs every filter, and compares errors, storage and cost with the paper."""
    quick = experiment.options.quick
    runs = experiment.size(2000, 8)
    used = runs_of.turn_methods(1000 if quick else 10_000)
    with experiment.timed("simulation"):
        worlds = runs_of.turn_worlds(experiment.key(0), runs)
    found = {
        name: _tracked_runs(experiment, i, name, method, worlds[method.in_order])
        for i, (name, method) in enumerate(used.items())
    }
    some = jax.tree.map(lambda x: x[:100], worlds[False])
    with experiment.timed("bounds"):
        bound = experiment.piece("bounds", lambda: runs_of.turn_bounds(some))
    held = {name: storage(method.estimator, 5).numbers for name, method in used.items()}
    experiment.arrays("turn", _turn_arrays(found, bound, held))
    experiment.figure("tracks", figures.turn_tracks(found))
    for number, kind in ((3, "position"), (4, "velocity")):
        experiment.figure(f"fig{number}_{kind}", figures.rms_panel(found, bound, kind))
    experiment.figure("pareto", figures.pareto_front(overall(found), found, held))
    experiment.table(
        "storage",
        f"Storage, lag {LAG}",
        storage_rows(5, 2, lag=LAG, particles=1000 if quick else 10_000),
    )
    experiment.table(
        "turn",
        f"Coordinated turn, {runs} runs, t >= {SETTLED} s",
        _turn_rows(found, held),
        [
            f"{EXACT}: of {found[EXACT]['position'].shape[0]} runs, relative to {EKS} on the same.",
            "s/run: on one core, one run after the other, without compiling.",
            runs_of.sigma_points_note(),
        ],
    )
    experiment.table(
        "claims",
        "What the paper says",
        turn_claims(found, bound, held),
        [
            "The parametric bound is that of a steady turn. Bounds of noisy motion hold on average",
            "over targets that the noise drives: on this one smooth path a filter may be better.",
            "The surest second: of the 26 from 5 s on, the one with most standard errors above 1,",
            "which have to be as many as make a chance hit in any of them as rare as in one row.",
        ],
    )
    experiment.finish()


def overall(found: dict[str, Arrays], kind: str = "position") -> dict[str, Measured]:
    """RMS error of every filter; of one that was given fewer runs, its ratio to PFoosmEKS on them
    times the error of that one."""
    errors = {name: rmse_of(settled_mean(one, kind)) for name, one in found.items()}
    every = settled_mean(found[EKS], kind)
    for name, one in found.items():
        runs = one[kind].shape[0]
        if runs < every.size:
            part, whole = ratio(settled_mean(one, kind), every[:runs]), errors[EKS]
            value = part.value * whole.value
            spread = np.hypot(part.error / part.value, whole.error / whole.value)
            errors[name] = Measured(value, float(value * spread))
    return errors


def _tracked_runs(
    experiment: Experiment,
    number: int,
    name: str,
    method: TurnMethod,
    batch: Simulation,
) -> Arrays:
    """Every run of one filter, in blocks that an interrupted study need not repeat."""
    runs = batch.truth.shape[0]
    runs = min(runs, max(round(method.share * runs), 8))
    keys = jax.random.split(experiment.key(1), batch.truth.shape[0])

    def block(begin: int) -> Arrays:
        index = slice(begin, min(begin + BLOCK, runs))
        some = jax.tree.map(lambda x: x[index], batch)
        with experiment.timed(name):
            return runs_of.followed_turns(method, some, keys[index])

    found = []
    with experiment.progress(name) as report:
        for begin in range(0, runs, BLOCK):
            found.append(experiment.piece(f"{number}-{begin}", partial(block, begin)))
            report(min(begin + BLOCK, runs), runs)
    return {key: np.concatenate([part[key] for part in found]) for key in found[0]}


def _turn_rows(found: dict[str, Arrays], held: dict[str, int]) -> list[dict[str, Any]]:
    position, velocity = overall(found), overall(found, "velocity")
    return [
        {
            "filter": name,
            "position RMS [m]": position[name],
            "velocity RMS [m/s]": velocity[name],
            "late used": float(one["late_used"].mean()),
            "rejected per run": mean_of(one["rejected"].astype(float)),
            "s/run": seconds_per_run(one["core_seconds"]),
            "numbers stored": held[name],
        }
        for name, one in found.items()
    ]


def _turn_arrays(found: dict[str, Arrays], bound: Arrays, held: dict[str, int]) -> xr.Dataset:
    names, fields = list(found), {}
    for kind, units in (("position", "m"), ("velocity", "m/s")):
        for name, one in found.items():
            field = f"{kind}_error_{name.replace(' ', '_')}"
            fields[field] = xr.DataArray(
                np.sqrt(one[kind]),
                dims=(f"run_of_{name.replace(' ', '_')}", "time"),
                attrs={"units": units},
            )
        rms = np.stack([np.sqrt(one[kind].mean(0)) for one in found.values()])
        fields[f"{kind}_rmse"] = xr.DataArray(rms, dims=("filter", "time"), attrs={"units": units})
        for begin in ("", "late_", "parametric_"):
            fields[f"{begin}pcrlb_{kind}"] = xr.DataArray(
                np.sqrt(bound[begin + kind]), dims="time", attrs={"units": units}
            )
    for count in ("late_used", "too_late", "rejected", "core_seconds"):
        fields[count] = xr.DataArray(
            [float(one[count].mean()) for one in found.values()], dims="filter"
        )
    fields["numbers_stored"] = xr.DataArray([held[name] for name in names], dims="filter")
    return xr.Dataset(fields).assign_coords(filter=names, time=("time", TIMES, {"units": "s"}))
