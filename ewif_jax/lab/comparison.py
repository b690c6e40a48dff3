"""What a comparison found: tables, arrays and pictures."""

from collections.abc import Iterator, Mapping
from functools import cached_property, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from ewif_jax import checks
from ewif_jax.lab import moments, tables
from ewif_jax.lab.design import Design
from ewif_jax.lab.engine import Tuned, Unit
from ewif_jax.lab.moments import PairedMoments
from ewif_jax.lab.store import Store
from ewif_jax.lab.units import STEP_SUMS
from ewif_jax.moments import Moments, shifted
from ewif_jax.moments import combined as combined_steps
from ewif_jax.types import Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Comparison:
    """Methods on the same runs, at every point of a grid.

    `table`, `plot`, `pareto` and `report` read the results chunk by chunk, so they need no more
    memory for more runs; `dataset` holds the score of every run.
    """

    def __init__(
        self,
        design: Design,
        store: Store,
        chunks: tuple[int, ...],
        tuned: Tuned,
        about: Mapping[str, Any],
    ) -> None:
        self.design = design
        self.about = dict(about)
        self._store = store
        self._chunks = chunks
        self._tuned = tuned

    @property
    def methods(self) -> list[str]:
        """Their names, in the order given."""
        return list(self.design.methods)

    @property
    def points(self) -> list[dict[str, float]]:
        """The points of the grid."""
        return self.design.points

    @property
    def runs(self) -> list[int]:
        """How many runs each point has."""
        found = [sum(self.design.runs_of(c) for c in range(count)) for count in self._chunks]
        return found

    def units(self, point: int) -> Iterator[dict[str, np.ndarray]]:
        """The results of a point (by number), chunk by chunk; `units.computed` says what is in
        them."""
        for chunk in range(self._chunks[point]):
            yield self._store.read(Unit(point, chunk).name)

    @cached_property
    def _moments(self) -> list[dict[str, PairedMoments]]:
        """Of every point, by metric."""
        kinds = [f"{kind}/{name}" for name in self.design.metrics for kind in ("score", "final")]
        found = []
        for point in range(len(self.points)):
            parts = [
                {kind: moments.paired_moments(arrays[kind]) for kind in kinds}
                for arrays in self.units(point)
            ]
            joined = {
                kind: reduce(moments.combined_pairs, (x[kind] for x in parts)) for kind in kinds
            }
            found.append(joined)
        return found

    @cached_property
    def _totals(self) -> list[dict[str, np.ndarray]]:
        """Counts of every point, added up over its chunks."""
        found = []
        for point in range(len(self.points)):
            total: dict[str, Any] = {}
            for arrays in self.units(point):
                for name, x in tables.counts(arrays).items():
                    total[name] = total[name] + x if name in total else x
            found.append(total)
        return found

    def table(self, reference: str | None = None, *, details: bool = False) -> pd.DataFrame:
        """One row for each point, metric and method.

        value, error: the mean over runs, or for a squared error its root (`kind` says which), and
        its standard error; difference, difference_error: minus `reference` on the same runs, with
        the standard error of the joint scatter (paired); rank: 1 is the smallest value; without:
        rows (per run) without an estimate, in which the prior stands in; missing: rows (per run)
        that have no score; runs. With limits: converged, converged_error: mean time to converge of
        the runs that did; not_converged, lost: shares of runs.

        Args:
            reference: name of a method.
            details: also the last row's value (`final`), and the shares of measurements with each
                `Status`.

        Raises:
            ValueError: no method of that name.
        """
        self._require_method("reference", reference)
        rows = []
        for number, point in enumerate(self.points):
            for name in self.design.metrics:
                found, total = self._moments[number], self._totals[number]
                rows += tables.metric_rows(
                    self.design, point, name, found, total, reference, details
                )
        return pd.DataFrame(rows)

    def summary(self, reference: str | None = None, *, details: bool = False) -> str:
        """`table` as text for people: a value and its error in one cell, and no column that says
        nothing."""
        return tables.text(self, reference, details)

    def _require_method(self, argument: str, name: str | None) -> None:
        expected = f"one of the methods {', '.join(self.methods)}"
        checks.require(name is None or name in self.methods, argument, expected, repr(name))

    @cached_property
    def cost(self) -> pd.DataFrame:
        """What each method costs at each point: seconds per arrival and run (filtering only,
        without compiling; the median over units of work), and what simulating costs."""
        rows = []
        for number, point in enumerate(self.points):
            spent = [
                (x["seconds"], float(x["simulating"]), self.design.chunk * self.design.steps)
                for x in self.units(number)
            ]
            per_arrival = np.median([seconds / count for seconds, _, count in spent], axis=0)
            simulating = float(np.median([s / count for _, s, count in spent]))
            for name, seconds in zip(self.methods, per_arrival, strict=True):
                own = {"seconds_per_arrival": seconds, "simulating_per_arrival": simulating}
                rows.append({**point, "method": name, **own})
        return pd.DataFrame(rows)

    @property
    def tuned(self) -> pd.DataFrame:
        """The parameters of tuned methods at each point, a column for each."""
        return tables.tuned_rows(self.points, self._tuned)

    @cached_property
    def dataset(self) -> xr.Dataset:
        """Labelled arrays: by metric its average of every run (axes of `over`, method, run), and
        its last value `NAME_final`; over time, `NAME_over_time` and `NAME_over_time_se` (..., step)
        and `time`; by method rows `without` an estimate and `status_share`. Choose by
        `sel({"method": NAME})`: `sel(method=...)` means something else to xarray."""
        return tables.dataset(self)

    @cached_property
    def over_time(self) -> dict[str, list[Moments]]:
        """By metric, of every point the averages over runs of each step.

        Raises:
            ValueError: they were not kept.
        """
        remedy = "a comparison that kept them, compare(..., time=True)"
        checks.require(self.design.over_time, "time", remedy, "time=False")
        found: dict[str, list[Moments]] = {}
        for name in self.design.metrics:
            keys = [f"{kind}/{name}" for kind in STEP_SUMS]
            found[name] = [
                reduce(
                    combined_steps,
                    (shifted(*(x[k].astype(float) for k in keys)) for x in self.units(point)),
                )
                for point in range(len(self.points))
            ]
        return found

    def times(self, point: int) -> np.ndarray:
        """(T,) the mean report times of a point's steps in seconds."""
        parts = [(arrays["time"], arrays["rows"].size) for arrays in self.units(point)]
        count = sum(n for _, n in parts)
        return sum(time * (n / count) for time, n in parts) + np.zeros(self.design.steps)

    def plot(self, x: str | None = None, metric: str | None = None, **options: Any) -> "Figure":
        """A figure of a metric against an axis of the grid (`x`, default the first), or against
        "time": a line with error bars (± 2 standard errors) for each method; one small panel for
        each point of the other axes.

        Args:
            x: an axis of `over`, or "time".
            metric: default the first.
            options: at={axis: number} picks values of other axes; reference=METHOD draws paired
                differences; log=True a logarithmic axis of the metric.

        Raises:
            ValueError: no such axis, metric or method; "time" if it was not kept.
        """
        from ewif_jax.lab.pictures import grid_figure

        return grid_figure(self, x, metric, **options)

    def pareto(self, cost: str = "seconds", metric: str | None = None, **options: Any) -> "Figure":
        """A figure of accuracy against cost, with the methods that no other beats in both joined.

        Args:
            cost: "seconds" (per arrival) or "numbers" (that a method stores).
            metric: default the first.
            options: at={axis: number} picks a point; default the first.
        """
        from ewif_jax.lab.pictures import pareto_figure

        return pareto_figure(self, cost, metric, **options)

    def report(self, path: str | Path, *, reference: str | None = None, title: str = "") -> Path:
        """Writes one page of HTML that needs nothing else: sortable tables, figures as SVG,
        settings and versions. Returns its path.

        Args:
            path: of the page.
            reference: as in `table`; default the first method.
            title: of the page.
        """
        from ewif_jax.lab.report import page

        self._require_method("reference", reference)
        from ewif_jax.lab.pieces import write_whole

        text = page(self, reference or self.methods[0], title)
        place = Path(path)
        write_whole(place, lambda half: half.write_text(text, encoding="utf-8"))
        return place

    def to_netcdf(self, path: str | Path) -> Path:
        """Writes `dataset` as a netCDF file; returns its path."""
        from ewif_jax.lab.pieces import write_whole

        data = tables.netcdf_bytes(self.dataset)
        place = Path(path)
        write_whole(place, lambda half: half.write_bytes(data))
        return place

    def __repr__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        return tables.html(self)

    def status_shares(self, point: int) -> dict[str, np.ndarray]:
        """By status, the share (M,) of measurements of a point."""
        counts = self._totals[point]["status"]
        shares = counts / np.maximum(counts.sum(1, keepdims=True), 1)
        return {status.name.lower(): shares[:, status] for status in Status}
