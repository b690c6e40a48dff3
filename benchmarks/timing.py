"""Wall-clock timing of callables, and its report as JSON and as a table."""

import json
import os
import platform
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import jax
import numpy as np

PACKAGES = (
    "jax",
    "jaxlib",
    "numpy",
    "scipy",
    "numba",
    "dynamax",
    "cuthbert",
    "simdkalman",
    "filterpy",
    "particles",
    "stonesoup",
    "ewif_jax",
)


def measure(
    calls: Mapping[str, Callable[[], object]], repeat: int = 7, budget: float | None = None
) -> dict[str, dict]:
    """Seconds of the first call of each function (compile and run), and of later ones.

    The later calls take turns, since the speed of a machine that is shared drifts by more than the
    differences between filters: what is compared was measured at the same time. In its turn a
    function is called once before the call that counts: what another leaves behind (caches full of
    its arrays, threads that spin a while before they sleep) is no property of this one.

    Args:
        calls: Functions of no arguments, by name, each returning a pytree of arrays, which is
            waited for.
        repeat: How many rounds of later calls.
        budget: Call a function no more once its later calls took this many seconds together; one
            is always timed.

    Returns:
        For each name ``first_s``, ``later_s`` (a list, in order), ``median_s``,
        ``lower_quartile_s``, ``upper_quartile_s``.
    """
    first = {name: _seconds(fn) for name, fn in calls.items()}
    later: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(max(repeat, 1)):
        for name, fn in calls.items():
            if not later[name] or budget is None or sum(later[name]) < budget:
                later[name].append(_seconds_of_its_own(fn))
    return {name: _summary(first[name], later[name]) for name in calls}


def _summary(first: float, later: list[float]) -> dict:
    lower, median, upper = np.quantile(later, [0.25, 0.5, 0.75])
    return {
        "first_s": first,
        "later_s": later,
        "median_s": float(median),
        "lower_quartile_s": float(lower),
        "upper_quartile_s": float(upper),
    }


def report(
    results: Iterable[dict], path: str | Path, references: Sequence[str] = ("dynamax",)
) -> None:
    """Write `results` with the environment to `path` as JSON, and print them as a table.

    Args:
        results: What `measure` returned, each with ``workload``, ``name``, ``run_steps`` (the
            steps of all runs that one call filters) and optionally ``note`` added.
        path: Where the JSON goes; missing folders are made.
        references: Names of results; the table shows the speed of each result relative to each
            of them within the same workload, as the median of the ratios within a round.
    """
    rows = [dict(row, run_steps_per_s=row["run_steps"] / row["median_s"]) for row in results]
    found = {(row["workload"], row["name"]): row for row in rows}
    for row in rows:
        row["speed_relative_to"] = {
            name: _ratio(row, found[row["workload"], name])
            for name in references
            if (row["workload"], name) in found
        }
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"environment": environment(), "results": rows}, indent=2) + "\n")
    print(_table(rows, references))


def _ratio(row: dict, reference: dict) -> float:
    """The speed of one relative to the other: the median over the rounds that both were in."""
    rounds = zip(row["later_s"], reference["later_s"], strict=False)
    quicker = float(np.median([theirs / ours for ours, theirs in rounds]))
    return quicker * row["run_steps"] / reference["run_steps"]


def environment() -> dict:
    """Date, processor, load and the versions of the packages that are installed."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "load_average": os.getloadavg() if hasattr(os, "getloadavg") else None,
        "jax_devices": [str(device) for device in jax.devices()],
        "python": platform.python_version(),
        "packages": {name: version for name in PACKAGES if (version := _version(name))},
    }


def _seconds(fn: Callable[[], object]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(fn())
    return time.perf_counter() - start


def _seconds_of_its_own(fn: Callable[[], object]) -> float:
    """Of the second of two calls; a long one does not notice what came before."""
    once = _seconds(fn)
    return once if once > 0.2 else _seconds(fn)


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    models = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor())


def _table(rows: Sequence[dict], references: Sequence[str]) -> str:
    """Aligned columns: text to the left, numbers to the right."""
    header = ["workload", "name", "M run-steps/s", "quartiles", "first s"]
    header += [f"x {name}" for name in references] + ["note"]
    cells = [header]
    for row in rows:
        slow, fast = (
            f"{row['run_steps'] / row[key] / 1e6:.4g}"
            for key in ("upper_quartile_s", "lower_quartile_s")
        )
        ratios = [row["speed_relative_to"].get(name) for name in references]
        cells.append(
            [
                row["workload"],
                row["name"],
                f"{row['run_steps_per_s'] / 1e6:.4g}",
                f"{slow} - {fast}",
                f"{row['first_s']:.2f}",
                *("" if ratio is None else f"{ratio:.3g}" for ratio in ratios),
                row.get("note", ""),
            ]
        )
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    left = {0, 1, len(header) - 1}
    return "\n".join(
        "  ".join(
            cell.ljust(width) if k in left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in cells
    )
