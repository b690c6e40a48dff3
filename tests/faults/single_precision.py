"""float32 beside float64: every estimator of the registry over many small steps.

Both get the same numbers, rounded to float32; an estimator that draws is compared with two of
float64 that draw otherwise. The table goes into docs/numerical-behaviour.md.

usage: PYTHONPATH=tests python tests/faults/single_precision.py [--steps 100000] [--only NAME ...]
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script it finds its neighbours

from contracts.registry import ROWS, Row

import ewif_jax as ej

PAGE = Path(__file__).parents[2] / "docs" / "numerical-behaviour.md"
BEGIN, END = "<!-- what single_precision.py wrote -->\n", "<!-- until here -->\n"
SEED, DT = 5, 0.01
EPS = float(np.finfo(np.float32).eps)
PARAMS = {"q": 1.0, "tau": 1.5, "fading": 1.1, "window": 0.065, "max_delay": 0.05}
if __name__ == "__main__":
    ej.prepare_cpu(1)  # before anything is computed
MODEL = ej.models.constant_velocity(
    sensors=ej.models.position_sensor(lambda p: p["r"]), q=lambda p: p["q"]
)


class World(NamedTuple):
    """r: variance of a measurement; place: where the target moves about; spread: variances of the
    prior; target: the error in sigma that float32 may make, beyond what storing the state costs."""

    r: float
    place: float
    spread: tuple[float, float]
    target: float


WORLDS = {
    "near": World(0.04, 0.0, (1.0, 1.0), 1e-3),
    "vague prior": World(0.04, 0.0, (4e3, 4e3), 1e-2),
    "tiny R": World(1e-6, 0.0, (1.0, 1.0), 1e-2),
    "1e6 m": World(100.0, 1e6, (100.0, 1.0), 1e-2),
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
    time = DT * np.arange(1, steps + 1)
    value = 3.0 * np.sin(0.8 * time) + world.place + np.sqrt(world.r) * rng.normal(size=steps)
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
        {**PARAMS, "r": world.r},
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
    usual = np.sqrt(np.mean(np.square((other - mean) / sd)))
    found = np.sqrt(np.mean(np.square(error)))
    return Found(found / usual, 0.0, abs(np.exp(np.mean(np.log(ratio))) - 1), variance.min(), lost)


def table(names: list[str], steps: int) -> Iterator[str]:
    """Its lines."""
    yield f"| estimator | {' | '.join(WORLDS)} |"
    yield f"|---|{'---|' * len(WORLDS)}"
    for row in ROWS:
        if names and row.name not in names:
            continue
        cells = []
        for name, world in WORLDS.items():
            try:
                found = compared(row, world, steps)
                print(row.name, name, found, file=sys.stderr, flush=True)
            except ValueError as error:
                print(row.name, name, error, file=sys.stderr, flush=True)
                cells.append("refused")
                continue
            cells.append(cell(found))
        yield f"| `{row.name}` | {' | '.join(cells)} |"


def cell(found: Found) -> str:
    return f"{found.worst:.1e} ({found.beyond:.0e}), {found.spread:.0e}"


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--steps", type=int, default=100_000)
    options.add_argument("--only", nargs="*", default=[])
    asked = options.parse_args()
    jax.config.update("jax_enable_x64", True)
    for line in table(asked.only, asked.steps):
        print(line, flush=True)


if __name__ == "__main__":
    main()
