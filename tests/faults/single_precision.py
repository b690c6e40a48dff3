"""float32 beside float64: every estimator of the registry over many small steps.

Both get the same numbers, rounded to float32; an estimator that draws is compared with two of
float64 that draw otherwise. The table goes into docs/numerical-behaviour.md.

usage: PYTHONPATH=tests python tests/faults/single_precision.py [--steps N] [--only NAME ...]
       [--write]
"""

import argparse
import platform
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script it finds its neighbours

from contracts.registry import ROWS, Row

import ewif_jax as ej

PAGE = Path(__file__).parents[2] / "docs" / "numerical-behaviour.md"
BEGIN, END = "<!-- written by tests/faults/single_precision.py -->", "<!-- until here -->"
SEED = 5
EPS = float(np.finfo(np.float32).eps)
TARGET = 1e-2
if __name__ == "__main__":
    ej.prepare_cpu(1)  # before anything is computed
MODEL = ej.models.constant_velocity(
    sensors=ej.models.position_sensor(lambda p: p["r"]), q=lambda p: p["q"]
)


class World(NamedTuple):
    """dt: seconds between measurements; r: variance of one; place, swing and rate: the target moves
    about `place` by swing sin(rate t); spread: variances of the prior; tau: seconds; target: the
    error in sigma that float32 may make beyond what storing the state costs."""

    dt: float
    r: float
    place: float = 0.0
    swing: float = 3.0
    rate: float = 0.8
    spread: tuple[float, float] = (1.0, 1.0)
    tau: float = 1.5
    target: float = TARGET

    @property
    def params(self) -> dict[str, float]:
        """Of every estimator of the registry."""
        lengths = {"window": 6.5 * self.dt, "max_delay": 5.0 * self.dt}
        return {
            "q": 1.0,
            "r": self.r,
            "tau": self.tau,
            "fading": 1.1,
            "probability": 0.99999,
            "c": 3.0,
            **lengths,
        }


WORLDS = {
    "near": World(0.01, 0.04, target=1e-3),
    "vague prior": World(0.01, 0.04, spread=(4e3, 4e3)),
    "tiny R": World(0.01, 1e-6, tau=0.1),
    "1e6 m, 1 Hz": World(1.0, 100.0, 1e6, 300.0, 0.01, (100.0, 1.0), 20.0),
    "1e6 m, 100 Hz": World(0.01, 100.0, 1e6, spread=(100.0, 1.0)),
}


class Found(NamedTuple):
    """worst: |difference of the means| in sigma of float64; beyond: what of it is more than 8 eps
    |mean| / sigma; spread: |ratio of the standard deviations - 1|; least: the smallest variance;
    lost: rows that are numbers in float64 only."""

    worst: float
    beyond: float
    spread: float
    least: float
    lost: int


def stream(world: World, steps: int, dtype: Any) -> ej.Measurement:
    """A moving target; of every sixteen rows one comes after the next."""
    rng = np.random.default_rng(SEED)
    time = world.dt * np.arange(1, steps + 1)
    value = world.swing * np.sin(world.rate * time) + world.place
    value += np.sqrt(world.r) * rng.normal(size=steps)
    order = np.arange(steps)
    late = np.arange(7, steps - 1, 16)
    order[late], order[late + 1] = late + 1, late
    return ej.stream(*(x[order].astype(np.float32).astype(dtype) for x in (time, value)))


def estimates(
    estimator: ej.Estimator, world: World, steps: int, dtype: Any, key: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations squared, (T, n) both."""
    mean = np.array([world.place, 0.0], dtype)
    prior = ej.Gaussian(mean, np.diag(world.spread).astype(dtype))
    trace = ej.run(
        estimator,
        world.params,
        stream(world, steps, dtype),
        prior=prior,
        t0=0.0,
        key=key,
    )
    variance = np.diagonal(np.asarray(trace.cov), axis1=1, axis2=2)
    return np.asarray(trace.mean, float), variance.astype(float)


def compared(row: Row, world: World, steps: int) -> Found:
    """What float32 makes of a world, beside float64."""
    estimator = row.build(MODEL)
    keys = [jax.random.key(k) for k in range(3)] if row.needs_key else [None]
    single, variance = estimates(estimator, world, steps, np.float32, keys[0])
    mean, wide = estimates(estimator, world, steps, np.float64, keys[-1])
    lost = int(np.sum(np.isfinite(mean).all(1) & ~np.isfinite(single).all(1)))
    both = np.isfinite(mean).all(1) & np.isfinite(single).all(1)
    single, variance, mean, wide = (x[both] for x in (single, variance, mean, wide))
    sd = np.sqrt(wide)
    error = np.abs(single - mean) / sd
    ratio = np.sqrt(np.maximum(variance, 0)) / sd
    if not row.needs_key:
        beyond = error - 8 * EPS * np.max(np.abs(mean) / sd, axis=1, keepdims=True)
        return Found(
            error.max(), max(beyond.max(), 0.0), np.abs(ratio - 1).max(), variance.min(), lost
        )
    other = estimates(estimator, world, steps, np.float64, keys[1])[0][both]
    spread_out = (sd > 0).all(1)
    if spread_out.mean() < 0.5:  # all members are one: there is no sigma to compare with
        return Found(np.nan, 0.0, np.nan, variance.min(), lost)
    error, ratio, other, mean, sd = (x[spread_out] for x in (error, ratio, other, mean, sd))
    usual = np.sqrt(np.mean(np.square((other - mean) / sd)))
    found = np.sqrt(np.mean(np.square(error)))
    return Found(found / usual, 0.0, abs(np.exp(np.mean(np.log(ratio))) - 1), variance.min(), lost)


def write(rows: dict[str, str], steps: int) -> None:
    """Puts rows into the page, beside those of other estimators that it has."""
    page = PAGE.read_text() if PAGE.exists() else f"{BEGIN}\n{END}\n"
    before, _, rest = page.partition(BEGIN)
    old, _, after = rest.partition(END)
    there = {line.split("`")[1]: line for line in old.splitlines() if line.startswith("| `")}
    what = f"ewif_jax {version('ewif_jax')}, jax {jax.__version__}, {platform.machine()}"
    lines = [
        f"{steps} steps, seed {SEED}; {what}.",
        "",
        f"| estimator | {' | '.join(WORLDS)} |",
        f"|---|{'---|' * len(WORLDS)}",
        *(line for row in ROWS if (line := {**there, **rows}.get(row.name))),
    ]
    PAGE.write_text("\n".join([before + BEGIN, *lines, END]) + after)


def cell(row: Row, world: World, steps: int) -> str:
    try:
        found = compared(row, world, steps)
    except ValueError as error:
        return f"refused: {str(error).partition(':')[0]}"
    print(row.name, found, file=sys.stderr, flush=True)
    held = 1.1 if row.needs_key else world.target
    error = found.worst if row.needs_key else found.beyond
    marks = "" if error <= held and found.least >= 0 and not found.lost else " **!**"
    if row.needs_key and np.isnan(found.worst):
        marks = "" if found.least >= 0 and not found.lost else " **!**"
        return f"no spread left{marks}"
    if row.needs_key:
        return f"{found.worst:.2f} times{marks}"
    beyond = f", {found.beyond:.1g} beyond" if found.beyond else ""
    return f"{found.worst:.1e}{beyond}{marks}"


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--steps", type=int, default=100_000)
    options.add_argument("--only", nargs="*", default=[])
    options.add_argument("--write", action="store_true", help=f"into {PAGE.name}")
    asked = options.parse_args()
    jax.config.update("jax_enable_x64", True)
    for row in ROWS:
        if not asked.only or row.name in asked.only:
            cells = [cell(row, world, asked.steps) for world in WORLDS.values()]
            line = f"| `{row.name}` | {' | '.join(cells)} |"
            print(line, flush=True)
            if asked.write:
                write({row.name: line}, asked.steps)
            jax.clear_caches()


if __name__ == "__main__":
    main()
