"""Wall-clock timing of callables, and its report as JSON and as a table."""

import json
import os
import platform
import time
from collections.abc import Callable, Iterable, Sequence
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


def measure(fn: Callable[[], object], repeat: int = 7, budget: float | None = None) -> dict:
    """Seconds of the first call of `fn` (compile and run) and quartiles of the later ones.

    Args:
        fn: Takes nothing and returns a pytree of arrays, which is waited for.
        repeat: How many later calls to time.
        budget: Start no further call once the later calls took this many seconds together; at
            least one is timed.

    Returns:
        ``first_s``, ``median_s``, ``lower_quartile_s``, ``upper_quartile_s``, ``repeat`` (the
        later calls timed).
    """
    first = _seconds(fn)
    later: list[float] = []
    while len(later) < max(repeat, 1) and (not later or budget is None or sum(later) < budget):
        later.append(_seconds(fn))
    lower, median, upper = np.quantile(later, [0.25, 0.5, 0.75])
    return {
        "first_s": first,
        "median_s": float(median),
        "lower_quartile_s": float(lower),
        "upper_quartile_s": float(upper),
        "repeat": len(later),
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
            of them within the same workload.
    """
    rows = [dict(row, run_steps_per_s=row["run_steps"] / row["median_s"]) for row in results]
    speed = {(row["workload"], row["name"]): row["run_steps_per_s"] for row in rows}
    for row in rows:
        row["speed_relative_to"] = {
            name: row["run_steps_per_s"] / speed[row["workload"], name]
            for name in references
            if (row["workload"], name) in speed
        }
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"environment": environment(), "results": rows}, indent=2) + "\n")
    print(_table(rows, references))


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
