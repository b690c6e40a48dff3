"""What mixed sensors, a gate, robust weights and several models cost: ``python -m
benchmarks.bench_fusion``.

Batches of 1024 runs of 200 rows in the plane, every run with a q of its own, so that nothing is
shared. Printed are seconds, and the ratio to the row above that they are compared with: sensors of
three sizes to the widest alone (one sensor index for all runs, or one for each), and a gate, robust
weights and an `imm` of two to the plain filter.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import ewif_jax as ej
from benchmarks.timing import measure, report

OUTPUT = Path(__file__).parent / "results" / "fusion.json"
RUNS, T = 1024, 200
PRIOR = ej.Gaussian(np.array([600.0, 500, 15, -6]), np.diag([2500.0, 2500, 25, 25]))
SENSORS = (
    ej.models.range_bearing_rate_sensor((625.0, 4e-4, 1.0)),
    ej.models.bearing_sensor(2.5e-5, (1500.0, -400.0)),
    ej.models.position_sensor(64.0, dims=2),
)
CHANGE = np.array([[0.95, 0.05], [0.1, 0.9]])
RATES = np.array([[-0.05, 0.05], [0.1, -0.1]], np.float32)
MOST = {
    "mixed, shared": 1.3,
    "mixed, per run": 2.0,
    "gated": 1.2,
    "imm of two": 2.8,
    "imm of two, in steps": 2.8,
}
"""the ratios that are aimed at"""


def moving(sensors, factor: float = 1.0) -> ej.Model:
    """Nearly constant velocity with params["q"]."""
    return ej.models.constant_velocity(sensors=sensors, q=lambda p: factor * p["q"], dims=2)


def changing(params: object, t0: jax.Array, t1: jax.Array) -> jax.Array:
    """What modes become over an interval, to first order in its length."""
    return jnp.eye(2) + (t1 - t0) * RATES


def streams(rng: np.random.Generator) -> dict[str, ej.Measurement]:
    """The radar alone; all three, the same sensor in every run, or each run's own; positions."""
    time = np.arange(1.0, T + 1, dtype=np.float32)
    place = np.array([600.0, 500]) + np.cumsum(rng.normal(size=(RUNS, T, 2)), 1)
    off = place - np.array([1500.0, -400])
    seen = np.full((3, RUNS, T, 3), np.nan, np.float32)
    seen[0, ..., 0], seen[0, ..., 1] = np.hypot(*place.T).T, np.arctan2(*place.T[::-1]).T
    seen[0, ..., 2] = rng.normal(size=(RUNS, T))
    seen[1, ..., 0] = np.arctan2(off[..., 1], off[..., 0])
    seen[2, ..., :2] = place
    shared = rng.integers(0, 3, T)
    own = rng.integers(0, 3, (RUNS, T))
    rows, columns = np.ogrid[:RUNS, :T]
    none = np.zeros(T, np.int32)
    given = {
        "widest": (seen[0], none),
        "shared": (seen[shared, rows, columns], shared.astype(np.int32)),
        "per run": (seen[own, rows, columns], own.astype(np.int32)),
        "positions": (seen[2, ..., :2], none),
    }
    return {
        name: ej.Measurement(time, np.nan_to_num(value), sensor, np.isfinite(value))
        for name, (value, sensor) in given.items()
    }


def calls() -> dict:
    """What is timed, by name."""
    rng = np.random.default_rng(0)
    given = streams(rng)
    params = {"q": rng.uniform(0.3, 1.0, RUNS).astype(np.float32)}
    radar, fleet = ej.extended(moving(SENSORS[0])), ej.extended(moving(SENSORS))
    plain = ej.kalman(moving(SENSORS[2]))
    modes = [ej.kalman(moving(SENSORS[2], factor)) for factor in (0.1, 10.0)]
    cases = {
        "widest alone": (radar, "widest"),
        "mixed, shared": (fleet, "shared"),
        "mixed, per run": (fleet, "per run"),
        "plain": (plain, "positions"),
        "gated": (ej.gated(plain), "positions"),
        "robust": (ej.robust(plain, 3.0), "positions"),
        "imm of two": (ej.imm(modes, changing), "positions"),
        "imm of two, in steps": (ej.imm(modes, CHANGE), "positions"),
    }

    def timed(estimator: ej.Estimator, name: str):
        def call() -> object:
            return ej.run_batch(
                estimator, params, given[name], prior=PRIOR, t0=0.0, params_per_run=True
            ).mean

        return call

    return {name: timed(*case) for name, case in cases.items()}


def main() -> None:
    """Prints the table of seconds, and the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    ej.prepare_cpu(1)
    found = measure(calls(), options.repeat)
    rows = [
        {"workload": "fusion", "name": name, "run_steps": RUNS * T, **one}
        for name, one in found.items()
    ]
    report(rows, options.output, ("widest alone", "plain"))
    for name, base in (
        ("mixed, shared", "widest alone"),
        ("mixed, per run", "widest alone"),
        ("gated", "plain"),
        ("robust", "plain"),
        ("imm of two", "plain"),
        ("imm of two, in steps", "plain"),
    ):
        pairs = zip(found[name]["later_s"], found[base]["later_s"], strict=True)
        ratio = float(np.median([x / y for x, y in pairs]))
        aim = f", at most {MOST[name]} is aimed at" if name in MOST else ""
        print(f"{name} over {base}: {ratio:.2f}{aim}")
    print(f"jax {jax.__version__}, one core")


if __name__ == "__main__":
    main()
