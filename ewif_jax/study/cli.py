"""The command `ewif-jax`."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from importlib.util import find_spec

import jax

from ewif_jax.fast.compiling import prepare_cpu
from ewif_jax.study.shared.arguments import parser
from ewif_jax.study.shared.refusal import Refused, Stopped, listen_for_signals
from ewif_jax.study.shared.registry import STUDIES

EXTRA = ("h5netcdf", "h5py", "matplotlib", "pandas", "pyproj", "rich", "xarray")
STOPPED = 130


def main() -> None:
    """Entry point: `prepare_cpu`, keeping programs, then `run`; a signal ends it with a message."""
    listen_for_signals()
    try:
        prepare_cpu(cache=True)
        status = run(sys.argv[1:])
    except Stopped as stopped:
        status = _complain_and_end(str(stopped), stopped.status)
    raise SystemExit(status)


def run(argv: Sequence[str]) -> int:
    """Does what the arguments say; returns the exit status."""
    arguments = parser().parse_args(argv)
    missing = [name for name in EXTRA if find_spec(name) is None]
    if missing:
        return _complain_and_end(f'needs {", ".join(missing)}: pip install "ewif_jax[study]"', 1)
    try:
        # before the imports, which take seconds
        if arguments.action == "track" and not arguments.file.is_file():
            what = "is not a regular file" if arguments.file.exists() else "no such file"
            raise Refused(f"{arguments.file}: {what}")
        with jax.enable_x64(arguments.dtype == "float64"):
            _act_on(arguments, shlex.join(["ewif-jax", *argv]))
    except (Refused, OSError) as error:
        return _complain_and_end(str(error), 2)
    except Stopped as stopped:
        return _complain_and_end(str(stopped), stopped.status)
    except KeyboardInterrupt:
        return _complain_and_end("stopped; the same command resumes what is finished", STOPPED)
    return 0


def _act_on(arguments: argparse.Namespace, command: str) -> None:
    from ewif_jax.study.shared.experiment import Experiment, Options

    options = Options(
        runs=arguments.runs,
        seed=arguments.seed,
        quick=arguments.quick,
        chunk=arguments.chunk,
        out=arguments.out,
        overwrite=arguments.overwrite,
        command=command,
    )
    if arguments.action == "track":
        from ewif_jax.study.track.command import track

        track(arguments, options)
        return
    for study in STUDIES:
        if arguments.name in (study.name, "all"):
            with Experiment(study.name, options) as experiment:
                study.load()(experiment)


def _complain_and_end(text: str, status: int) -> int:
    print(f"ewif-jax: {text}", file=sys.stderr)
    return status
