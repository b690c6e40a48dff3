"""What is printed of streams and results: a few lines, and in notebooks a small table."""

from collections.abc import Mapping
from html import escape
from typing import Any

import jax
import numpy as np
from jax.core import Tracer


def at_hand(*arrays: Any) -> bool:
    """Whether these are arrays whose numbers are known; what stands in their place in a pytree
    (flags, axes, shapes, tracers) is not."""
    kinds = np.ndarray | jax.Array
    return all(isinstance(x, kinds) and not isinstance(x, Tracer) for x in arrays)


def stream_lines(name: str, time: Any, value: Any, sensor: Any, mask: Any) -> dict[str, str] | None:
    """Of a `Measurement` (T, ...) or (R, T, ...); None where its numbers are not known."""
    if not at_hand(time, value, sensor, mask) or np.ndim(value) not in (2, 3):
        return None
    time, mask, sensor = np.asarray(time), np.asarray(mask), np.asarray(sensor)
    if time.size == 0 or np.ndim(time) == 0:
        return None
    late = time < np.maximum.accumulate(time, axis=-1)
    runs = f"{np.shape(value)[0]} runs of " if np.ndim(value) == 3 else ""
    size = np.shape(value)[-1]
    missing = int((~mask).sum())
    return {
        name: f"{runs}{np.shape(value)[-2]} arrivals of {size} number{'s' * (size > 1)}",
        "time": f"{time.min():g} to {time.max():g} s",
        "late": f"{late.mean():.0%} of the arrivals",
        "sensors": ", ".join(f"{x}" for x in np.unique(sensor)[:8]),
        "missing": f"{missing} of {mask.size} numbers",
    }


def trace_lines(time: Any, mean: Any, cov: Any, status: Any, kinds: Any) -> dict[str, str] | None:
    """Of a `Trace`; `kinds` are the statuses."""
    if not at_hand(time, mean, cov, status) or np.ndim(mean) not in (2, 3):
        return None
    time, mean, cov = np.asarray(time), np.asarray(mean), np.asarray(cov)
    runs = f"{mean.shape[0]} runs of " if mean.ndim == 3 else ""
    became = np.asarray(status)
    shares = {kind.name.lower().replace("_", " "): np.mean(became == kind) for kind in kinds}
    lines = {
        "Trace": f"{runs}{mean.shape[-2]} arrivals, a state of {mean.shape[-1]} numbers",
        "time": f"{time.min():g} to {time.max():g} s",
        "measurements": ", ".join(f"{share:.0%} {name}" for name, share in shares.items() if share),
    }
    if mean.ndim == 2:
        spread = np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0))
        pairs = zip(mean[-1][:8], spread[-1][:8], strict=True)
        lines["last estimate"] = ", ".join(f"{x:.4g} ± {s:.2g}" for x, s in pairs)
    return lines


def as_text(lines: Mapping[str, str]) -> str:
    """A line for each entry, the names in a column."""
    (name, first), *rest = lines.items()
    width = max(map(len, lines))
    return "\n".join([f"{name}: {first}", *(f"  {k:<{width}} {v}" for k, v in rest)])


def as_html(lines: Mapping[str, str]) -> str:
    """The same as a small table."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{escape(k)}</th>"
        f"<td style='text-align:left'>{escape(v)}</td></tr>"
        for k, v in lines.items()
    )
    return f"<table>{rows}</table>"
