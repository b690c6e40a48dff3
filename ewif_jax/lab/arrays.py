"""What filters, studies and tuning found, as tables and labelled arrays."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import pandas as pd
import xarray as xr

from ewif_jax import checks
from ewif_jax.analysis.consistency import nis
from ewif_jax.monte_carlo import Statistics
from ewif_jax.tuning import Tuned
from ewif_jax.types import Numbers, Status, Trace


def to_frame(trace: Trace, names: Sequence[str] | None = None) -> pd.DataFrame:
    """A table with a row for each arrival: time, mean and standard deviation of every state
    component, delay, status (a word), NIS and log likelihood of the measurement; for a batch (R, T)
    a row for each run and arrival.

    Args:
        trace: of `run` or `run_batch`.
        names: of the state components (default x0, x1, ...).

    Raises:
        ValueError: what is no trace, or another number of names.
    """
    names = _state_names(trace, names)
    mean = np.asarray(trace.mean)
    cov = np.asarray(trace.cov)
    lead = mean.shape[:-1]
    spread = np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0))
    columns: dict[str, np.ndarray] = {}
    if len(lead) == 2:
        columns["run"] = np.broadcast_to(np.arange(lead[0])[:, None], lead)
    columns["time"] = np.broadcast_to(np.asarray(trace.time), lead)
    for k, name in enumerate(names):
        columns[name] = mean[..., k]
    for k, name in enumerate(names):
        columns[f"{name}_sd"] = np.broadcast_to(spread, mean.shape)[..., k]
    info = trace.info
    columns["delay"] = np.broadcast_to(np.asarray(info.delay), lead)
    words = np.asarray([status.name.lower() for status in Status])
    columns["status"] = words[np.broadcast_to(np.asarray(info.status), lead)]
    columns["nis"] = np.broadcast_to(np.asarray(nis(info)), lead)
    columns["log_likelihood"] = np.broadcast_to(np.asarray(info.log_likelihood), lead)
    return pd.DataFrame({name: np.ravel(x) for name, x in columns.items()})


def to_xarray(found: Trace | Statistics | Tuned, names: Sequence[str] | None = None) -> xr.Dataset:
    """Labelled arrays of a `Trace` (time or step, state), a `Statistics` (run, step) or a `Tuned`
    (step of the descent).

    Args:
        found: what `run`, `run_batch`, `monte_carlo` or `tune` returned.
        names: of the state components of a trace (default x0, x1, ...).

    Raises:
        ValueError: anything else.
    """
    if isinstance(found, Trace):
        return _of_trace(found, names)
    if isinstance(found, Statistics):
        return _of_statistics(found)
    expected = "a Trace, Statistics or Tuned"
    checks.require(isinstance(found, Tuned), "found", expected, type(found).__name__)
    return _of_tuned(found)


def _state_names(trace: Trace, names: Sequence[str] | None) -> list[str]:
    checks.require(isinstance(trace, Trace), "trace", "a Trace", type(trace).__name__)
    size = np.shape(trace.mean)[-1]
    found = [f"x{k}" for k in range(size)] if names is None else list(names)
    checks.require(len(found) == size, "names", f"{size} names of state components", found)
    return found


def _of_trace(trace: Trace, names: Sequence[str] | None) -> xr.Dataset:
    names = _state_names(trace, names)
    info = trace.info
    lead = ("run", "step") if np.ndim(trace.mean) == 3 else ("step",)

    def over_steps(x: Numbers, *tail: str) -> Any:
        x = np.asarray(x)
        short = x.ndim < len(lead) + len(tail)
        return ((lead[1:] if short else lead) + tail, x)

    variables = {
        "mean": over_steps(trace.mean, "state"),
        "cov": over_steps(trace.cov, "state", "other_state"),
        "innovation": over_steps(info.innovation, "component"),
        "innovation_cov": over_steps(info.innovation_cov, "component", "other_component"),
        "log_likelihood": over_steps(info.log_likelihood),
        "delay": (*over_steps(info.delay), {"units": "s"}),
        "status": (*over_steps(info.status), {"meaning": _status_meaning()}),
    }
    time = over_steps(trace.time)
    coords = {"time": (*time, {"units": "s"}), "state": names, "other_state": names}
    return xr.Dataset(variables, coords)


def _status_meaning() -> str:
    return ", ".join(f"{status.value}: {status.name}" for status in Status)


def _of_statistics(found: Statistics) -> xr.Dataset:
    variables: dict[str, Any] = {}
    for name in found.per_run:
        variables[name] = ("run", np.asarray(found.per_run[name]))
        variables[f"{name}_missing"] = ("run", np.asarray(found.missing[name]))
        variables[f"{name}_over_time"] = ("step", np.asarray(found.per_step[name]))
        variables[f"{name}_over_time_se"] = ("step", np.asarray(found.per_step_se[name]))
    return xr.Dataset(variables)


def _of_tuned(found: Tuned) -> xr.Dataset:
    variables: dict[str, Any] = {"loss": ("step", np.asarray(found.history["loss"]))}
    for path, x in jax.tree_util.tree_leaves_with_path(found.history["params"]):
        name = jax.tree_util.keystr(path, simple=True, separator=".") or "params"
        x = np.asarray(x)
        tail = tuple(f"{name}_{k}" for k in range(x.ndim - 1))
        variables[f"params.{name}" if name == "loss" else name] = (("step", *tail), x)
    return xr.Dataset(variables, attrs={"reason": found.reason, "best_loss": float(found.loss)})
