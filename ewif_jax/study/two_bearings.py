"""Pornsarayouth & Yamakita, sections 5 and 6: two rotating bearing sensors, one of them late."""

from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from ewif_jax.analysis.storage import storage
from ewif_jax.study import two_bearings_figures as figures
from ewif_jax.study import two_bearings_runs as runs_of
from ewif_jax.study.claims import claim, quotient, ratio, share, surest
from ewif_jax.study.experiment import Experiment, Measured
from ewif_jax.study.folder import Arrays
from ewif_jax.study.late import mean_of, rmse
from ewif_jax.study.late_methods import storage_rows
from ewif_jax.study.one_by_one import seconds_per_run
from ewif_jax.study.two_bearings_runs import (
    DELAYS,
    EKF,
    ENKF1,
    ENKF2,
    EXACT,
    HALF,
    LAG,
    MEMBERS,
    ONE,
    OTHER,
    PF,
    RTS,
    SHARED,
    Method,
    World,
)

NONE, FIVE, TEN = range(3)
"""which of `DELAYS`"""
SETTLED, LOST = 20.0, 50.0


def run(experiment: Experiment) -> None:
    """Simulates each delay, runs every filter on it, and compares them with the paper."""
    runs = experiment.size(100, 8)
    used = runs_of.methods(1000 if experiment.options.quick else 10_000)
    with experiment.timed("simulation"):
        world = runs_of.simulated(experiment.key(0), runs)
    found = {
        name: experiment.piece(f"filter-{i}", partial(_timed, experiment, name, method, world))
        for i, (name, method) in enumerate(used.items())
    }
    with experiment.timed("bounds"):
        bound = experiment.piece("bounds", lambda: runs_of.bounds(world))
    truth = np.reshape(world.batch.truth, (len(DELAYS), runs, -1, 2))
    for k, delay in enumerate(DELAYS):
        stem = f"delay_{delay:g}s"
        experiment.figure(f"{stem}_tracks", figures.tracks(found, truth[k, 0], k, delay))
        experiment.figure(f"{stem}_errors", figures.errors(found, bound, world.times[k], k, delay))
    experiment.figure("delays", figures.by_delay(*_summary(found, bound, world.times), DELAYS))
    experiment.arrays("two_bearings", _dataset(found, bound, world.times))
    experiment.table("storage", f"Storage, lag {LAG}", storage_rows(4, 1, lag=LAG, members=MEMBERS))
    experiment.table(
        "two_bearings", f"Two bearings, {runs} runs, t >= {SETTLED:g} s",
        _rows(found, bound, world.times, used),
        [f"lost: share of runs that are ever more than {LOST:g} m off; a RMSE with lost runs in it",
         "says little. s/run: on one core, one run after the other, without compiling."],
    )  # fmt: skip
    experiment.table(
        "claims", "What the paper says", claims(found, bound, world.times),
        [f"runs: how many decide. Ratios are over those in which neither filter is ever {LOST:g} m",
         "off. Nearest rival: of EKF, RTS-based, EnKF2, also with shared noise, and exact replay,",
         "the one from which EnKF1 differs least surely. Times are those of one core."],
    )  # fmt: skip
    experiment.finish()


def squared(error: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Mean squared position error (D, R) after the filters have settled."""
    return _settled(np.sum(error**2, -1), times)


def reported(variance: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Mean standard deviation of the position (D, R) after the filters have settled."""
    return _settled(np.sqrt(np.sum(variance, -1)), times)


def lost(error: np.ndarray) -> np.ndarray:
    """Which runs (D, R) were ever far off."""
    return np.nanmax(np.sum(error**2, -1), -1) > LOST**2


def claims(found: dict[str, Arrays], bound: Arrays, times: np.ndarray) -> list[dict[str, Any]]:
    """What the paper says about its filters, and three comparisons it does not make."""
    off = {name: squared(one["error"], times) for name, one in found.items()}
    sd = {name: reported(one["variance"], times) ** 2 for name, one in found.items()}
    gone = {name: lost(one["error"]) for name, one in found.items()}
    printed = reported(bound["published"], times) ** 2
    every = off[EKF].shape[1]

    def row(text: str, published: str, ours: Measured, runs: int = every, **limit: Any) -> Any:
        return {"runs": runs, **claim(text, published, ours, **limit)}

    def kept(delay: int, *names: str) -> np.ndarray:
        return ~np.any([gone[name][delay] for name in names], 0)

    def against(
        values: Any, one: str, other: str, delay: int, published: str, **limit: Any
    ) -> dict[str, Any]:
        both = kept(delay, one, other)
        what = "RMSE" if values is off else "SD"
        return row(
            f"{one} over {other} at {DELAYS[delay]:g} s ({what} ratio)", published,
            ratio(values[one][delay][both], values[other][delay][both]), int(both.sum()), **limit,
        )  # fmt: skip

    def cost(one: str, other: str, published: str) -> dict[str, Any]:
        pair = (seconds_per_run(found[name]["core_seconds"].ravel()) for name in (one, other))
        return row(f"{one} over {other} (time ratio)", published, quotient(*pair), below=1)

    five = (EKF, RTS, ENKF1, ENKF2, PF)
    alike = kept(NONE, *five)
    ranked = sorted(five, key=lambda name: sd[name][NONE][alike].mean())
    rivals = {name: kept(FIVE, ENKF1, name) for name in (EKF, RTS, ENKF2, SHARED, EXACT)}
    worst = surest(
        ratio(off[name][FIVE][both], off[ENKF1][FIVE][both]) for name, both in rivals.items()
    )
    seen = kept(FIVE, EKF)
    few = "a difference of 2 or 3 %, which a hundred runs hardly tell"
    return [
        row("largest over smallest SD of five filters at 0 s", "close to one another",
            ratio(sd[ranked[-1]][NONE][alike], sd[ranked[0]][NONE][alike]), int(alike.sum()),
            below=1.5),
        row("runs lost by either sensor when alone, at 5 s (share)", "false tracking",
            share(gone[ONE][FIVE] & gone[OTHER][FIVE]), above=0.5),
        row("nearest rival over EnKF1 at 5 s (RMSE ratio)", "EnKF1 is the worst", worst,
            min(int(both.sum()) for both in rivals.values()), below=1),
        row("runs that EnKF2 loses at 5 s (share)", "very good", share(gone[ENKF2][FIVE]),
            below=0.1),
        row("lost with half the particles, less lost with all, at 5 s (share)",
            "unstable with 5000", mean_of(gone[HALF][FIVE].astype(float) - gone[PF][FIVE]),
            above=0),
        against(sd, PF, EKF, FIVE, "still high", above=1),
        row("runs that the PF loses at 10 s (share)", "unstable", share(gone[PF][TEN]), above=0.3),
        row("lost by the PF, less lost by EnKF2, at 10 s (share)", "EnKF2 is more stable",
            mean_of(gone[PF][TEN].astype(float) - gone[ENKF2][TEN]), above=0),
        row("the printed bound over the SD of the EKF at 5 s", "much worse",
            ratio(printed[FIVE][seen], sd[EKF][FIVE][seen]), int(seen.sum()), above=1),
        against(off, RTS, EKF, TEN, "RTS is better", below=1),
        against(off, RTS, ENKF2, TEN, "RTS is better", below=1),
        against(off, EKF, ENKF2, TEN, "EKF is superior", below=1, reason=few),
        cost(ENKF2, PF, "consumes less"),
        cost(EKF, ENKF2, "consumes less"),
        against(off, EXACT, RTS, TEN, "not tried", below=1),
        against(off, SHARED, ENKF2, TEN, "not tried", below=1),
        against(off, SHARED, EKF, TEN, "not tried", below=1),
    ]  # fmt: skip


def _timed(experiment: Experiment, name: str, method: Method, world: World) -> Arrays:
    with experiment.timed(name):
        return runs_of.followed(method, world, experiment.key(1))


def _settled(values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Means over the arrivals of (D, R, T) from 20 s on."""
    return np.stack([x[:, t >= SETTLED].mean(1) for x, t in zip(values, times, strict=True)])


def _summary(
    found: dict[str, Arrays], bound: Arrays, times: np.ndarray
) -> tuple[dict[str, Any], Any, dict[str, Any]]:
    """Mean squares (D, R) by filter and of the bound, and which runs are lost."""
    off = {name: squared(one["error"], times) for name, one in found.items()}
    floor = squared(np.sqrt(bound["right"]), times)
    return off, floor, {name: lost(one["error"]) for name, one in found.items()}


def _rows(
    found: dict[str, Arrays], bound: Arrays, times: np.ndarray, used: dict[str, Method]
) -> list[dict[str, Any]]:
    off, _, gone = _summary(found, bound, times)
    rows: list[dict[str, Any]] = []
    for k, delay in enumerate(DELAYS):
        for name, method in used.items():
            rows.append({
                "delay [s]": delay,
                "estimator": name,
                "RMSE [m]": rmse(off[name][k]),
                "mean SD [m]": mean_of(reported(found[name]["variance"], times)[k]),
                "median [m]": float(np.median(np.sqrt(off[name][k]))),
                "lost": share(gone[name][k]),
                "s/run": seconds_per_run(found[name]["core_seconds"][k]),
                "numbers stored": storage(method.estimator, 4).numbers,
            })  # fmt: skip
        for name, kind in (("PCRLB", "right"), ("PCRLB as published", "published")):
            value = rmse(squared(np.sqrt(bound[kind]), times)[k])
            empty: dict[str, Any] = dict.fromkeys(rows[0])
            rows.append({**empty, "delay [s]": delay, "estimator": name, "RMSE [m]": value})
    return rows


def _dataset(found: dict[str, Arrays], bound: Arrays, times: np.ndarray) -> xr.Dataset:
    dims, metres = ("estimator", "delay", "run", "arrival", "axis"), {"units": "m"}

    def stacked(values: list[np.ndarray]) -> xr.DataArray:
        x = np.stack(values)
        return xr.DataArray(x, dims=dims[: x.ndim], attrs=metres)

    every = list(found.values())
    fields = {
        "error": stacked([one["error"] for one in every]),
        "reported_sd": stacked([np.sqrt(one["variance"]) for one in every]),
        "rmse_of_run": stacked([np.sqrt(squared(one["error"], times)) for one in every]),
        "arrival_time": xr.DataArray(times, dims=("delay", "arrival"), attrs={"units": "s"}),
    }
    for kind, name in (("right", "pcrlb"), ("published", "pcrlb_published")):
        fields[name] = xr.DataArray(np.sqrt(bound[kind]), dims=dims[1:], attrs=metres)
    return xr.Dataset(fields).assign_coords(
        estimator=list(found), axis=["x", "y"], delay=("delay", list(DELAYS), {"units": "s"})
    )
