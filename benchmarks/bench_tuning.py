"""How surely and how soon `tune` finds an optimum: ``python -m benchmarks.bench_tuning``.

Twelve losses, twenty random starts each, over four decades of every parameter. The optimum is that
of a grid, refined by golden sections along each parameter in turn: it uses no gradient and no code
of `tune`. An evaluation is a value and a gradient at one vector of parameters. A start has found
the optimum where its loss is at most 1 % above (of the loss, and of how far the median start lies
above the optimum, whichever is less).
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import ewif_jax as ej

OUTPUT = Path(__file__).parent / "results" / "tuning.json"
METHODS = {"quasi-newton": {}, "lbfgs": {"method": "lbfgs"}, "adam": {"method": "adam"}}
GRID = 25


class Problem(NamedTuple):
    """A loss, and about which parameters its starts are drawn."""

    loss: Callable[..., Any]
    centre: dict[str, float]


def in_the_plane(time: np.ndarray, value: np.ndarray, late: bool, seed: int) -> ej.Measurement:
    """The stream, in sequence or with a third of it late by up to four intervals."""
    rng = np.random.default_rng(seed)
    step = np.median(np.diff(time))
    delay = np.where(rng.uniform(size=len(time)) < 0.3, rng.uniform(0, 4 * step, len(time)), 0)
    return ej.stream(time, value, arrival=time + delay) if late else ej.stream(time, value)


def newest_truth(stream: ej.Measurement, times: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The truth (T, k) at the newest time that has arrived."""
    newest = np.maximum.accumulate(np.asarray(stream.time))
    return truth[np.searchsorted(times, newest - 1e-9)]


def sine(late: bool) -> Problem:
    """tau of a filter of a scalar that stands still, by RMSE."""
    rng = np.random.default_rng(0)
    times = 0.1 * np.arange(101)
    truth = np.sin(0.2 * np.pi * times)[:, None]
    value = truth + np.sqrt(0.5) * rng.normal(size=truth.shape)
    stream = in_the_plane(times, value, late, 1)
    model = ej.models.random_walk(sensors=ej.models.position_sensor(0.5))
    estimator = ej.ewif(model, lambda p: p["tau"])
    truth = newest_truth(stream, times, truth)
    return Problem(ej.rmse_loss(estimator, stream, truth, prior=None, t0=0.0), {"tau": 0.5})


def chirp(late: bool) -> Problem:
    """q and r of constant velocity after a chirp with two gaps, by likelihood."""
    rng = np.random.default_rng(2)
    times = 0.1 * np.arange(1, 161)
    gap = ((times > 4) & (times < 6)) | ((times > 10) & (times < 11))
    truth = np.sin(0.5 * times + 0.06 * times**2)[:, None]
    value = np.where(gap[:, None], np.nan, truth + 0.2 * rng.normal(size=truth.shape))
    stream = in_the_plane(times, value, late, 3)
    model = ej.models.constant_velocity(
        sensors=ej.models.position_sensor(lambda p: p["r"]), q=lambda p: p["q"]
    )
    estimator = ej.al1(model, 12) if late else ej.kalman(model)
    prior = ej.Gaussian(np.zeros(2), np.diag([1.0, 1.0]))
    return Problem(ej.likelihood_loss(estimator, stream, prior=prior, t0=0.0), {"q": 1.0, "r": 0.1})


def walk(late: bool) -> Problem:
    """q and the variances of two sensors of a random walk, by likelihood."""
    rng = np.random.default_rng(4)
    times = np.cumsum(rng.exponential(0.2, 200))
    path = np.cumsum(np.sqrt(25 * np.diff(times, prepend=0)) * rng.normal(size=200))
    sensor = np.arange(200) % 2
    noise = np.where(sensor == 0, 20.0, 5.0) * rng.normal(size=200)
    delay = rng.exponential(0.5, 200) if late else np.zeros(200)
    stream = ej.stream(times, (path + noise)[:, None], sensor, arrival=times + delay)
    sensors = [ej.models.position_sensor(lambda p, k=k: p[k]) for k in ("r0", "r1")]
    model = ej.models.random_walk(sensors=sensors, q=lambda p: p["q"])
    estimator = ej.asd(model, 16) if late else ej.kalman(model)
    prior = ej.Gaussian(np.zeros(1), 100 * np.eye(1))
    loss = ej.likelihood_loss(estimator, stream, prior=prior, t0=0.0)
    return Problem(loss, {"q": 10.0, "r0": 100.0, "r1": 100.0})


def arrowhead(late: bool) -> Problem:
    """tau of a filter of constant velocity on the arrowhead of Yoder et al., by RMSE."""
    times = np.arange(300.0)
    truth = np.asarray(ej.scenarios.arrowhead_path(jnp.asarray(times)))[:, :2]
    value = truth + np.sqrt(2000.0) * np.random.default_rng(5).normal(size=truth.shape)
    delay = np.random.default_rng(6).exponential(5.0, 300) if late else np.zeros(300)
    stream = ej.stream(times, value, arrival=times + delay)
    model = ej.models.constant_velocity(sensors=ej.models.position_sensor(2000.0, dims=2), dims=2)
    estimator = ej.ewif(model, lambda p: p["tau"])
    truth = newest_truth(stream, times, truth)
    return Problem(ej.rmse_loss(estimator, stream, truth, prior=None, t0=0.0), {"tau": 10.0})


def bearings(late: bool) -> Problem:
    """q and r of an extended filter between two rotating bearing sensors, by likelihood."""
    scenario = ej.scenarios.two_bearings(5.0 if late else 0.0)
    drawn = ej.simulate_batch(scenario, jax.random.split(jax.random.key(7), 4))
    model = ej.scenarios.two_bearings_model(lambda p: p["q"], lambda p: p["r"])
    estimator = ej.al1(model, 12)
    loss = ej.likelihood_loss(estimator, drawn.measurements, prior=scenario.prior, t0=0.0)
    return Problem(loss, {"q": 0.1, "r": 3e-6})


def opensky(late: bool, file: Path) -> Problem:
    """q and r of constant velocity of eight aircraft of OpenSky, by likelihood, in kilometres."""
    import pandas as pd

    table = pd.read_csv(file)
    groups = sorted(table.groupby("icao24"), key=lambda pair: -len(pair[1]))[:8]
    rows = min(120, *(len(g) for _, g in groups))
    streams = []
    for k, (_, group) in enumerate(groups):
        group = group.sort_values("time").iloc[:rows]
        north = 111.2 * (group.lat - group.lat.iloc[0])
        east = 111.2 * np.cos(np.deg2rad(group.lat.iloc[0])) * (group.lon - group.lon.iloc[0])
        times = (group.time - group.time.iloc[0]).to_numpy(float) + 10.0
        streams.append(in_the_plane(times, np.stack([east, north], -1), late, 10 + k))
    batch = jax.tree.map(lambda *x: np.stack(x), *streams)
    model = ej.models.constant_velocity(
        sensors=ej.models.position_sensor(lambda p: p["r"], dims=2), q=lambda p: p["q"], dims=2
    )
    estimator = ej.al1(model, 12) if late else ej.kalman(model)
    prior = ej.Gaussian(np.zeros(4), np.diag([1.0, 1.0, 0.1, 0.1]))
    loss = ej.likelihood_loss(estimator, batch, prior=prior, t0=0.0)
    return Problem(loss, {"q": 1e-6, "r": 1e-3})


def problems(file: Path | None) -> dict[str, Callable[[], Problem]]:
    """Builders by name; without a file of OpenSky there are ten."""
    found = {}
    for build in (sine, chirp, walk, arrowhead, bearings):
        for late in (False, True):
            found[build.__name__ + ", late" * late] = lambda b=build, x=late: b(x)
    if file is not None:
        for late in (False, True):
            found["opensky" + ", late" * late] = lambda x=late: opensky(x, file)
    return found


def least(problem: Problem) -> tuple[float, dict[str, float]]:
    """The least loss of a grid over six decades, refined along each parameter in turn."""
    names = list(problem.centre)
    many = jax.jit(jax.vmap(lambda x: problem.loss(dict(zip(names, jnp.exp(x), strict=True)))))
    centre = np.log([problem.centre[n] for n in names])
    count = GRID if len(names) < 3 else 13
    axes = np.meshgrid(*[np.linspace(-3, 3, count) * np.log(10.0)] * len(names), indexing="ij")
    points = centre + np.stack([a.ravel() for a in axes], -1)
    values = np.asarray(many(points))
    best = points[np.nanargmin(values)]
    width = 6 * np.log(10.0) / (count - 1)
    offsets = np.linspace(-1, 1, 9)
    for _ in range(40):
        before = best.copy()
        for k in range(len(names)):
            line = np.repeat(best[None], 9, 0)
            line[:, k] += width * offsets
            best = line[np.nanargmin(np.asarray(many(line)))]
        # A valley across the axes: also along the way it has just come.
        line = best + np.outer(4 * offsets, best - before)
        best = line[np.nanargmin(np.asarray(many(line)))]
        if np.abs(best - before).max() < width / 8:
            width /= 2
    value = float(many(best[None])[0])
    return value, dict(zip(names, map(float, np.exp(best)), strict=True))


def tried(problem: Problem, options: dict[str, Any], starts: dict[str, Any]) -> dict[str, Any]:
    """Ends, evaluations and seconds of the first call and of a second."""
    params = {k: jnp.asarray(v) for k, v in problem.centre.items()}
    begun = time.perf_counter()
    tuned = ej.tune(problem.loss, params, starts=starts, steps=200, **options)
    first = time.perf_counter() - begun
    begun = time.perf_counter()
    ej.tune(problem.loss, params, starts=starts, steps=200, **options)
    seconds = time.perf_counter() - begun
    return {
        "losses": [t.loss for t in tuned.starts],
        "first_losses": [float(t.history["loss"][0]) for t in tuned.starts],
        "evaluations": [t.evaluations for t in tuned.starts],
        "reasons": [t.reason for t in tuned.starts],
        "params": [{k: float(v) for k, v in t.params.items()} for t in tuned.starts],
        "first_s": first,
        "later_s": seconds,
    }


def main() -> None:
    """Tunes each problem from its starts by each method, and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--opensky", type=Path, help="a CSV of state vectors of OpenSky")
    parser.add_argument("--only", default="")
    parser.add_argument("--methods", nargs="*", default=list(METHODS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    results, totals = [], {}
    print(f"ewif_jax tuning, seed {options.seed}, {options.starts} starts, jax {jax.__version__}")
    for number, (name, build) in enumerate(problems(options.opensky).items()):
        if options.only and options.only not in name:
            continue
        problem = build()
        optimum, at = least(problem)
        rng = np.random.default_rng([options.seed, number])
        starts = {k: at[k] * 10.0 ** rng.uniform(-2, 2, options.starts) for k in problem.centre}
        shown = ", ".join(f"{k} {v:.3g}" for k, v in at.items())
        print(f"{name}: least {optimum:.5f} at {shown}")
        for method in options.methods:
            found = tried(problem, METHODS[method], starts)
            fall = np.median(found["first_losses"]) - optimum
            margin = 0.01 * min(abs(optimum), fall)
            good = np.asarray(found["losses"]) <= optimum + margin
            evaluations = np.mean(found["evaluations"])
            print(
                f"  {method:13} {good.mean():7.0%} found, {evaluations:6.1f} evaluations a start, "
                f"first {found['first_s']:6.1f} s, again {found['later_s']:6.2f} s",
                flush=True,
            )
            for k in np.flatnonzero(~good)[:3]:
                start = {n: float(v[k]) for n, v in starts.items()}
                print(f"    from {start}: {found['losses'][k]:.5f}, {found['reasons'][k]}")
            results.append(
                {"problem": name, "method": method, "optimum": optimum, "at": at, **found}
                | {"found": good.tolist(), "seed": options.seed, "version": jax.__version__}
            )
            totals.setdefault(method, []).append((good.mean(), evaluations))
    for method, rows in totals.items():
        share, count = np.mean(rows, 0)
        print(f"{method}: {share:.1%} found, {count:.1f} evaluations a start")
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
