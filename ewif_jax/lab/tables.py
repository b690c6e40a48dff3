"""Rows, arrays and text of a comparison."""

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
import pandas as pd
import xarray as xr

from ewif_jax.lab import moments
from ewif_jax.lab.design import Design
from ewif_jax.lab.moments import PairedMoments
from ewif_jax.moments import standard_error
from ewif_jax.types import Status

if TYPE_CHECKING:
    from ewif_jax.lab.comparison import Comparison


def counts(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What of a unit is added up over units."""
    found = {"status": arrays["status"], "without": arrays["without"]}
    found |= {"runs": np.asarray(arrays["rows"].size), "rows": arrays["rows"].sum()}
    for name, x in arrays.items():
        kind, _, metric = name.partition("/")
        if kind == "missing":
            found[name] = x
        elif kind == "lost":
            found[name] = x.sum(1)
        elif kind == "converged":
            is_there = np.isfinite(x)
            times = np.where(is_there, x, 0.0).astype(float)
            found[f"times/{metric}"] = np.stack(
                [is_there.sum(1).astype(float), times.sum(1), (times**2).sum(1)]
            )
    return found


def metric_rows(
    design: Design,
    point: Mapping[str, float],
    metric: str,
    found: Mapping[str, PairedMoments],
    total: Mapping[str, Any],
    reference: str | None,
    details: bool,
) -> list[dict[str, Any]]:
    """The rows of `Comparison.table` of one point and metric."""
    names, root = list(design.methods), metric in design.roots
    value, error = moments.means(found[f"score/{metric}"], root)
    final, final_error = moments.means(found[f"final/{metric}"], root)
    columns: dict[str, np.ndarray] = {"value": value, "error": error}
    if reference is not None:
        apart = moments.differences(found[f"score/{metric}"], names.index(reference), root)
        columns |= {"difference": apart[0], "difference_error": apart[1]}
    order = pd.Series(value).rank(method="min")
    columns |= {"rank": order.astype("Int64").to_numpy(object)}
    if details:
        columns |= {"final": final, "final_error": final_error}
    if f"times/{metric}" in total:
        columns |= _convergence_rows(total[f"times/{metric}"], int(total["runs"]))
    if f"lost/{metric}" in total:
        columns |= {"lost": total[f"lost/{metric}"] / total["runs"]}
    columns |= {"without": total["without"] / total["runs"]}
    # What has no estimate and no stand-in has no score either: it is told once.
    columns |= {"missing": total[f"missing/{metric}"] / total["runs"]}
    columns |= {"runs": np.full(len(names), int(total["runs"]))}
    if details:
        shares = total["status"] / np.maximum(total["status"].sum(1, keepdims=True), 1)
        columns |= {status.name.lower(): shares[:, status] for status in Status}
    head = {**point, "metric": metric, "kind": "root mean" if root else "mean"}
    return [
        {**head, "method": name, **{column: x[k] for column, x in columns.items()}}
        for k, name in enumerate(names)
    ]


def _convergence_rows(sums: np.ndarray, runs: int) -> dict[str, np.ndarray]:
    count, total, squares = sums
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total / count
        variance = np.maximum(squares / count - mean**2, 0) * count / (count - 1)
        error = np.sqrt(variance / count)
    return {"converged": mean, "converged_error": error, "not_converged": 1 - count / runs}


def tuned_rows(
    points: list[dict[str, float]], tuned: Mapping[int, Mapping[str, Any]]
) -> pd.DataFrame:
    """A row for each point and tuned method."""
    found = []
    for number, by_method in tuned.items():
        for name, params in by_method.items():
            leaves = jax.tree_util.tree_leaves_with_path(params)
            own = {_path_values(path): np.asarray(x)[()] for path, x in leaves}
            found.append({**points[number], "method": name, **own})
    return pd.DataFrame(found)


def _path_values(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".") or "params"


def dataset(comparison: "Comparison") -> xr.Dataset:
    """The arrays of `Comparison.dataset`."""
    design, names = comparison.design, comparison.methods
    sizes = tuple(len(values) for values in design.axes.values())
    axes, most = tuple(design.axes), max(comparison.runs)
    variables: dict[str, Any] = {}

    def gridded(parts: list[np.ndarray], dims: tuple[str, ...], **attrs: str) -> Any:
        whole = np.stack(parts)
        return (*axes, *dims), whole.reshape(*sizes, *whole.shape[1:]), attrs

    def of_runs(kind: str, **attrs: str) -> Any:
        parts = []
        for point in range(len(comparison.points)):
            found = np.concatenate([x[kind] for x in comparison.units(point)], 1)
            full = np.full((len(names), most), np.nan)
            full[:, : found.shape[1]] = found
            parts.append(full)
        return gridded(parts, ("method", "run"), **attrs)

    for name in design.metrics:
        squared = "mean square" if name in design.roots else "mean"
        variables[name] = of_runs(f"score/{name}", average=f"{squared} over the rows of a run")
        variables[f"{name}_final"] = of_runs(f"final/{name}", average="of the last row")
        limits = design.limits.get(name)
        if limits is not None and limits.converged is not None:
            variables[f"{name}_converged"] = of_runs(f"converged/{name}", units="s")
        if limits is not None and limits.lost is not None:
            variables[f"{name}_lost"] = of_runs(f"lost/{name}")
        if design.over_time:
            steps = comparison.over_time[name]
            over = f"{name}_over_time"
            variables[over] = gridded([x.mean for x in steps], ("method", "step"))
            errors = [standard_error(x) for x in steps]
            variables[f"{over}_se"] = gridded(errors, ("method", "step"))
    points = range(len(comparison.points))
    if design.over_time:
        variables["time"] = gridded([comparison.times(p) for p in points], ("step",), units="s")
    shares = [np.stack(list(comparison.status_shares(p).values()), 1) for p in points]
    variables["status_share"] = gridded(shares, ("method", "status"), units="1")
    without = [comparison._totals[p]["without"] / comparison.runs[p] for p in points]
    variables["without"] = gridded(without, ("method",), meaning="rows per run without an estimate")
    coords = {name: list(values) for name, values in design.axes.items()}
    coords |= {"method": names, "run": np.arange(most), "status": [s.name for s in Status]}
    about = {name: str(value) for name, value in comparison.about.items()}
    return xr.Dataset(variables, coords, about)


def netcdf_bytes(found: xr.Dataset) -> bytes:
    """The dataset as a netCDF 4 file. HDF5 crashes the process when it cannot write what is left as
    it closes a file on a full disk, so it gets memory."""
    import h5netcdf

    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as file:
        found.dump_to_store(xr.backends.H5NetCDFStore(file))  # type: ignore[arg-type]
    return buffer.getvalue()


def shown_cells(value: float, error: float) -> str:
    """A value with as many digits as its error allows: "1.234 ± 0.012"."""
    if not np.isfinite(error) or error <= 0:
        return f"{value:.4g}"
    digits = max(1 - int(np.floor(np.log10(error))), 0)
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def for_people(table: pd.DataFrame) -> pd.DataFrame:
    """A table with value and error in one cell, and columns that say nothing left out."""
    found = table.copy()
    errors = {name: f"{name}_error" for name in ("difference", "final", "converged")}
    for name, error in {"value": "error", **errors}.items():
        if name in found:
            pairs = zip(found[name], found.pop(error), strict=True)
            found[name] = [shown_cells(*pair) for pair in pairs]
    counted = ["without", "missing", *(status.name.lower() for status in Status)]
    counted = [name for name in counted if name in found]
    dull = [name for name in counted if not np.any(found[name].to_numpy())]
    for name in set(counted) - set(dull):
        found[name] = [f"{x:.3g}" for x in found[name]]
    dull += [name for name in ("metric", "kind") if len(set(found[name])) == 1]
    found = found.drop(columns=dull)
    return found.rename(columns=lambda c: c.replace("_", " "))


def text(comparison: "Comparison", reference: str | None, details: bool) -> str:
    """The table as text, under a line that says what it is."""
    table = for_people(comparison.table(reference, details=details))
    return f"{_table_head(comparison)}\n{table.to_string(index=False)}"


def html(comparison: "Comparison") -> str:
    """The table for a notebook."""
    table = for_people(comparison.table())
    return f"<p>{_table_head(comparison)}</p>{table.to_html(index=False)}"


def _table_head(comparison: "Comparison") -> str:
    runs, metrics = comparison.runs, ", ".join(comparison.design.metrics)
    count = f"{runs[0]}" if len(set(runs)) == 1 else f"{min(runs)} to {max(runs)}"
    methods, points = len(comparison.methods), len(comparison.points)
    return (
        f"{methods} method{'s' * (methods > 1)}, {points} point{'s' * (points > 1)}, {count} runs"
        f"{' each' * (points > 1)}: {metrics} ± standard error"
    )
