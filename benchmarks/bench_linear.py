"""Time `kalman` and other packages on L1: ``python -m benchmarks.bench_linear [--quick]``.

(a) all runs share the process noise, (b) each run has its own. All peers must agree on the
means. The Numba kernel is compiled once for all its rows: only the first shows the compilation.
The machine may be shared and its speed may drift: the filters take turns, and the ratios within one
table are what to compare.
"""

import argparse
from functools import partial
from pathlib import Path

import jax

import ewif_jax as ej
from benchmarks import ours
from benchmarks.peers import NOTES, PEERS, SPLIT_PEERS, TIMED_RUNS, check
from benchmarks.timing import measure, report
from benchmarks.workloads import constant_acceleration

OUTPUT = Path(__file__).parent / "results" / "linear.json"


def main() -> None:
    """Time the peers, check that they agree, print the table and write the JSON."""
    options = _options()
    if options.unprepared:
        jax.config.update("jax_num_cpu_devices", options.devices)
    else:
        ej.prepare_cpu(options.devices)
    filters = _filters(options.peers, options.devices)
    results = _measure_all(filters, options)
    errors = check(filters)  # afterwards, so that first calls are timed with nothing compiled
    for row in results:
        row["error_in_standard_deviations"] = errors[row["name"]]
    report(results, options.output, references=options.references)


def _filters(names: list[str], devices: int) -> dict:
    """Select the peers named; those that can, again with their runs split over `devices`."""
    filters = {"ewif_jax": ours.kalman_filter} | {name: PEERS[name] for name in names}
    if devices > 1:
        filters[f"ewif_jax, {devices} devices"] = partial(ours.kalman_filter, devices=devices)
        filters |= {
            f"{name}, {devices} devices": partial(SPLIT_PEERS[name], devices=devices)
            for name in names
            if name in SPLIT_PEERS
        }
    return filters


def _measure_all(filters: dict, options: argparse.Namespace) -> list[dict]:
    """Time every filter on L1 (a) and (b), in the form that `report` takes."""
    results = []
    for label, per_run in (("L1a", False), ("L1b", True)):
        workload = constant_acceleration(options.runs, options.steps, per_run=per_run)
        calls = {name: build(workload) for name, build in filters.items()}
        for name, times in measure(calls, options.repeat, options.budget).items():
            row = {
                "workload": label,
                "name": name,
                "run_steps": min(TIMED_RUNS.get(name, options.runs), options.runs) * options.steps,
                "note": NOTES.get(name, ""),
            }
            results.append(row | times)
    return results


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, help="1024, or 128 with --quick")
    parser.add_argument("--steps", type=int, help="1000, or 100 with --quick")
    parser.add_argument("--quick", action="store_true", help="a small size and few repeats")
    parser.add_argument("--repeat", type=int, help="later calls to time: 9, or 3 with --quick")
    parser.add_argument("--budget", type=float, default=10.0, help="seconds for them, each row")
    parser.add_argument("--devices", type=int, default=1, help="JAX host devices")
    parser.add_argument("--unprepared", action="store_true", help="without `prepare_cpu`")
    parser.add_argument("--peers", nargs="+", default=list(PEERS), choices=list(PEERS))
    parser.add_argument("--references", nargs="*", default=["dynamax", "numba 1 thread"])
    parser.add_argument("--output", type=Path, default=OUTPUT, help="JSON file")
    options = parser.parse_args()
    for name, full, small in (("runs", 1024, 128), ("steps", 1000, 100), ("repeat", 9, 3)):
        if getattr(options, name) is None:
            setattr(options, name, small if options.quick else full)
    return options


if __name__ == "__main__":
    main()
