"""Methods for late measurements on fixed streams: ``python -m benchmarks.oosm [--quick]``."""

import argparse
import sys
import time as clock
from importlib import metadata
from pathlib import Path

import jax
import pandas as pd

import ewif_jax as ej
from benchmarks.oosm import report
from benchmarks.oosm.files import Columns, from_file
from benchmarks.oosm.methods import methods, reference
from benchmarks.oosm.others import OTHERS
from benchmarks.oosm.scores import best_of, found_by, scored
from benchmarks.oosm.streams import CASES, Stream, drawn

OUTPUT = Path(__file__).parent / "results"
TIMED = "short delays"
"""The stream on which single arrivals are timed."""
PACKAGES = ("ewif_jax", "jax", "numpy", "filterpy", "kalbee", "stonesoup")


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(prog="python -m benchmarks.oosm", description=__doc__)
    made.add_argument("--runs", type=int, help="of each stream (16, or 4 with --quick)")
    made.add_argument("--steps", type=int, help="rows of a run (60, or 30 with --quick)")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--quick", action="store_true", help="small, and single arrivals not timed")
    made.add_argument("--only", help="methods, with commas between them")
    made.add_argument("--streams", help=f"some of: {', '.join(CASES)}")
    made.add_argument("--out", type=Path, default=OUTPUT, help="folder of the results")
    file = made.add_argument_group("a file of yours, in place of the streams")
    file.add_argument("--file", type=Path, help="a CSV")
    file.add_argument("--time", default="time")
    file.add_argument("--arrival", default="arrival")
    file.add_argument("--value", default="x,y", help="two columns")
    file.add_argument("--latlon", help="two columns, in place of --value")
    file.add_argument("--track", help="column that tells tracks apart")
    file.add_argument("--delay", type=float, default=0.0, help="mean of added delays, s")
    file.add_argument("--q", type=float, default=1.0, help="process noise, m^2/s^3")
    file.add_argument("--r", type=float, default=100.0, help="variance of a coordinate, m^2")
    return made


def main(arguments: list[str] | None = None) -> pd.DataFrame:
    """Filters everything, writes table and figure, and prints the table."""
    options = parser().parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    runs = options.runs or (4 if options.quick else 16)
    steps = options.steps or (30 if options.quick else 60)
    only = None if options.only is None else [name.strip() for name in options.only.split(",")]
    rows, begun = [], clock.perf_counter()
    for stream, training in streams_of(options, runs, steps):
        live = stream.name == TIMED and not options.quick
        start = clock.perf_counter()
        rows += rows_of(stream, training, only, live)
        print(f"{stream.name}: {clock.perf_counter() - start:.0f} s", file=sys.stderr)
    table = pd.DataFrame(rows)
    took = f"{clock.perf_counter() - begun:.0f} s, {clock.process_time():.0f} s of processors"
    about = f"{runs} runs of {steps} rows, seed {options.seed}; {versions()}; took {took}"
    report.write(table, about, options.out)
    print(f"{about}\n\n{report.markdown(table)}")
    return table


def streams_of(options: argparse.Namespace, runs: int, steps: int):
    """Each stream, and other runs of it to tune on."""
    if options.file is not None:
        names = tuple((options.latlon or options.value).split(","))
        columns = Columns(
            options.time, options.arrival, names, options.latlon is not None, options.track
        )
        given = (runs, steps, options.delay, options.q, options.r)
        yield from_file(options.file, columns, *given, options.seed), None
        return
    names = CASES if options.streams is None else [x.strip() for x in options.streams.split(",")]
    for name in names:
        yield drawn(name, runs, steps, options.seed), drawn(name, 8, steps, options.seed + 1)


def rows_of(stream: Stream, training: Stream | None, only: list[str] | None, live: bool):
    """A row for each method that can filter this stream."""
    exact = found_by(reference(stream.world), stream)
    rows = [{"stream": stream.name, "method": report.EXACT, "ours": True, "note": ""}]
    rows[0] |= scored(exact, exact, stream)
    ours = methods(stream.world)
    others = OTHERS if stream.world.is_linear else {}
    for name, candidates in [*ours.items(), *others.items()]:
        if only is not None and name not in only:
            continue
        row = {"stream": stream.name, "method": name, "ours": name in ours, "note": ""}
        try:
            # Without other runs, of which the truth is known, nothing is tuned.
            best = candidates[0] if training is None else best_of(candidates, training)
            row |= scored(found_by(best, stream, live), exact, stream)
        except ModuleNotFoundError as error:
            row["note"] = f"{error.name} is not installed"
        rows.append(row)
    return rows


def versions() -> str:
    """Of what took part."""
    found = []
    for name in PACKAGES:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            found.append(f"{name} not installed")
    return ", ".join(found)


if __name__ == "__main__":
    ej.prepare_cpu(1)
    main()
