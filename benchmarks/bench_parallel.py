"""Time one long series, L3: ``python -m benchmarks.bench_parallel [--steps 1000000]``.

The EWIF arrival by arrival (`run`) against the same filter parallel in time (`run_parallel`), both
returning everything a `Trace` holds. Memory is what the compiled program takes for its results and
its working space.
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.timing import measure, report
from benchmarks.workloads import long_series
from ewif_jax.estimator import run
from ewif_jax.estimators.ewif import ewif
from ewif_jax.fast.compiling import prepare_cpu
from ewif_jax.models import constant_acceleration, position_sensor
from ewif_jax.parallel import run_parallel
from ewif_jax.streams import stream

OUTPUT = Path(__file__).parent / "results" / "parallel.json"
TAU = 2.0


def main() -> None:
    """Time both, check that they agree, print the table and write the JSON."""
    options = _options()
    if not options.unprepared:
        prepare_cpu(1)
    jax.config.update("jax_enable_x64", True)
    series = long_series(options.steps)
    model = constant_acceleration(sensors=position_sensor(float(series.R[0, 0])))
    estimator = ewif(model, tau=_tau)
    data = jax.tree.map(jnp.asarray, stream(series.time, series.value))

    def sequential(data):
        return run(estimator, TAU, data, prior=None, t0=0.0)

    def parallel(method, block):
        return lambda data: run_parallel(
            model, TAU, data, tau=_tau, prior=None, t0=0.0, method=method, block=block
        )

    rows = {"run": sequential, "run_parallel": parallel("blocked", options.block)}
    if options.associative:
        rows["run_parallel associative"] = parallel("associative", options.block or 32)
    results = []
    calls = {name: partial(fn, data) for name, fn in rows.items()}
    for name, times in measure(calls, options.repeat, options.budget).items():
        note = f"{_megabytes(rows[name], data):.0f} MB"
        row = {"workload": "L3", "name": name, "run_steps": options.steps, "note": note}
        results.append(row | times)
    truth = np.asarray(sequential(data).mean)
    for row, fn in zip(results, rows.values(), strict=True):
        row["largest_difference"] = float(np.nanmax(np.abs(np.asarray(fn(data).mean) - truth)))
    report(results, options.output, references=["run"])


def _tau(params):
    return params


def _megabytes(fn, data) -> float:
    """Results and working space of the compiled program, in 10^6 bytes."""
    memory = jax.jit(fn).lower(data).compile().memory_analysis()
    return (memory.output_size_in_bytes + memory.temp_size_in_bytes) / 1e6


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--block", type=int, help="arrivals per block; default sqrt(steps)")
    parser.add_argument("--repeat", type=int, default=5, help="later calls to time")
    parser.add_argument("--budget", type=float, default=30.0, help="seconds for them, each row")
    parser.add_argument("--associative", action="store_true", help="also the prefix sum")
    parser.add_argument("--unprepared", action="store_true", help="without `prepare_cpu`")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="JSON file")
    return parser.parse_args()


if __name__ == "__main__":
    main()
