"""What a study is given: its options, the screen, and a place for what it finds."""

import datetime
import io
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import h5netcdf
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from ewif_jax.lab import Comparison, Method, compare
from ewif_jax.lab.pieces import Arrays
from ewif_jax.lab.timing import timed
from ewif_jax.monte_carlo import Scenario
from ewif_jax.study.shared.folder import Folder
from ewif_jax.study.shared.refusal import Refused, stop_if_asked
from ewif_jax.types import Estimator, Numbers

__all__ = ("Experiment", "Measured", "Options", "Refused", "shown_number")


class Measured(NamedTuple):
    """A number and its standard error."""

    value: float
    error: float


class Options(NamedTuple):
    """The options common to all studies; runs=None and chunk=None leave the choice to the study."""

    runs: int | None = None
    seed: int = 0
    quick: bool = False
    chunk: int | None = None
    out: Path = Path("results")
    overwrite: bool = False
    command: str = ""


class Experiment:
    """One study in progress; a context, in which no other process works in its folder.

    Everything it saves goes into a partial folder that takes its final name in `finish`. `table`,
    `arrays` and `figure` save; `piece` saves work that a later run can resume from; `progress` and
    `timed` are for long work.
    """

    def __init__(
        self, name: str, options: Options, settings: Mapping[str, Any] | None = None
    ) -> None:
        self.name = name
        self.options = options
        self.console = Console(highlight=False)
        if not self.console.is_terminal:
            self.console.width = 140
        self.timings: dict[str, dict[str, float]] = {}
        self.about = {
            "study": name,
            "command": options.command,
            "seed": options.seed,
            "runs": options.runs,
            "quick": options.quick,
            **(settings or {}),
            "version": version("ewif_jax"),
            "dtype": str(jnp.asarray(0.0).dtype),
        }
        identity = {k: v for k, v in self.about.items() if k != "command"}
        self.folder = Folder(options.out, name, identity)
        self.folder.claim(options.overwrite)
        self.about |= {
            "source": self.folder.settings["source"],
            "devices": [str(device) for device in jax.devices()],
            "machine": f"{platform.system()} {platform.machine()}, Python "
            f"{platform.python_version()}, jax {jax.__version__}, numpy {np.__version__}",
            "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        }

    def __enter__(self) -> "Experiment":
        return self

    def __exit__(self, *failure: object) -> None:
        self.folder.leave()

    def size(self, full: int, quick: int) -> int:
        """How many runs: what the user asked for, or the study's own choice."""
        return self.options.runs or (quick if self.options.quick else full)

    def key(self, number: int) -> jax.Array:
        """An independent PRNG key of the study's seed for each `number`."""
        return jax.random.fold_in(jax.random.key(self.options.seed), number)

    def say(self, text: str) -> None:
        """Prints a line, as it is."""
        self.console.print(text, markup=False)

    @contextmanager
    def timed(self, label: str) -> Iterator[None]:
        """Adds the block's compile and run seconds to the account of `label`."""
        with timed() as timing:
            yield
        account = self.timings.setdefault(label, {"compile_s": 0.0, "run_s": 0.0})
        account["compile_s"] += timing.compile
        account["run_s"] += timing.run

    @contextmanager
    def progress(self, label: str) -> Iterator[Callable[..., None]]:
        """A progress bar, moved by calling what it yields with (done, total)."""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        bar = Progress(
            *columns,
            TimeRemainingColumn(),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )
        with bar:
            task = bar.add_task(label, total=None)

            def update(done: int, total: int, *_: Any) -> None:
                stop_if_asked()
                bar.update(task, completed=done, total=total)

            yield update

    def compare(
        self,
        name: str,
        methods: Mapping[str, Estimator | Method],
        scenario: Scenario,
        **setting: Any,
    ) -> Comparison:
        """`lab.compare`, shown and timed; a later run goes on behind the last chunk of runs that an
        interrupted one has finished."""
        folder, chunk = self.folder.work(name), self.options.chunk
        with self.timed(name), self.progress(name) as report:
            return compare(
                methods, scenario, folder=folder, chunk=chunk, progress=report, **setting
            )

    def piece(self, name: str, compute: Callable[[], Mapping[str, Any]]) -> Arrays:
        """The arrays of `compute()`, read back if an interrupted run has already computed them
        and they are whole."""
        found = self.folder.piece(name, compute)
        if name in self.folder.broken:
            self.say(f"The earlier work {name!r} was not whole; computed again.")
            self.folder.broken.remove(name)
        return found

    def table(
        self, name: str, title: str, rows: Sequence[Mapping[str, Any]], notes: Sequence[str] = ()
    ) -> None:
        """Prints rows and saves them as `name`.csv: a `Measured` is printed "value ± error" and
        saved in two columns, the second with "_se" after its name."""
        caption = Text("\n".join(notes)) if notes else None
        table = Table(title=Text(title), caption=caption, caption_justify="left")
        for column in rows[0]:
            numeric = any(isinstance(r[column], float | int | Measured) for r in rows)
            table.add_column(Text(column), justify="right" if numeric else "left")
        for row in rows:
            table.add_row(*(Text(shown_number(value)) for value in row.values()))
        self.console.print(table)
        self.csv(name, pd.DataFrame([_flat_row(row) for row in rows]))

    def csv(self, name: str, frame: pd.DataFrame) -> None:
        """Saves a data frame as `name`.csv."""
        self.folder.write(f"{name}.csv", lambda path: frame.to_csv(path, index=False))

    def arrays(self, name: str, dataset: xr.Dataset) -> None:
        """Saves labelled arrays as `name`.nc (netCDF 4) with the description of the study."""
        about = {key: str(value) for key, value in self.about.items()}
        labelled = dataset.assign_attrs({**about, **dataset.attrs})
        # HDF5 crashes the process when it cannot write what is left as it closes a file on a full
        # disk, so it gets memory.
        buffer = io.BytesIO()
        with h5netcdf.File(buffer, "w") as file:
            labelled.dump_to_store(xr.backends.H5NetCDFStore(file))  # type: ignore[arg-type]
        self.folder.write(f"{name}.nc", lambda path: path.write_bytes(buffer.getbuffer()))

    def figure(self, name: str, figure: Figure) -> None:
        """Saves a figure as `name`.png."""
        self.folder.write(f"{name}.png", lambda path: figure.savefig(path, dpi=150, format="png"))

    def finish(self) -> None:
        """Puts the results in their place and says where they are."""
        total = {k: sum(t[k] for t in self.timings.values()) for k in ("compile_s", "run_s")}
        about = {**self.about, **total, "timings": self.timings}
        if self.folder.resumed:
            self.say(f"Resumed from earlier work: {', '.join(self.folder.resumed)}.")
        earlier = self.folder.finish(about, self.options.overwrite)
        seconds = f"compiling {total['compile_s']:.1f} s, running {total['run_s']:.1f} s"
        self.say(f"Results in {self.folder.final} ({seconds}).")
        if earlier is not None:
            self.say(f"The earlier results are kept in {earlier} (--overwrite replaces them).")
        if self.folder.kept:
            kept = ", ".join(str(path) for path in self.folder.kept)
            self.say(f"Kept, for it is not of this program: {kept}.")
        if self.folder.unfinished():
            self.say(f"Unfinished work with other settings stays in {self.folder.partial.parent}.")


def shown_number(value: Numbers) -> str:
    """A table cell: four significant digits, an error rounded to two, nothing for None."""
    match value:
        case None:
            return ""
        case Measured(number, error) if np.isfinite(error) and error > 0:
            digits = max(1 - int(np.floor(np.log10(error))), 0)
            return f"{number:.{digits}f} ± {error:.{digits}f}"
        case Measured(number, _):
            return f"{number:.4g}"
        case float():
            return f"{value:.4g}"
        case _:
            return str(value)


def _flat_row(row: Mapping[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for column, value in row.items():
        if isinstance(value, Measured):
            flat |= {column: value.value, f"{column}_se": value.error}
        else:
            flat[column] = value
    return flat
