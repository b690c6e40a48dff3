"""The command `ewif-jax`."""

import shlex
import sys
from collections.abc import Sequence
from importlib.util import find_spec

import jax

from ewif_jax.fast.compiling import prepare_cpu
from ewif_jax.study.shared.arguments import parser
from ewif_jax.study.shared.registry import STUDIES

EXTRA = ("h5netcdf", "h5py", "matplotlib", "pandas", "pyproj", "rich", "xarray")


def main() -> None:
    """Entry point: `prepare_cpu`, then `run`."""
    prepare_cpu()
    raise SystemExit(run(sys.argv[1:]))


def run(argv: Sequence[str]) -> int:
    """Does what the arguments say; returns the exit status."""
    arguments = parser().parse_args(argv)
    missing = [name for name in EXTRA if find_spec(name) is None]
    if missing:
        return _complain(f'needs {", ".join(missing)}: pip install "ewif_jax[study]"', 1)
    from ewif_jax.study.shared.experiment import Experiment, Options, Refused

    options = Options(
        runs=arguments.runs,
        seed=arguments.seed,
        quick=arguments.quick,
        chunk=arguments.chunk,
        out=arguments.out,
        overwrite=arguments.overwrite,
        command=shlex.join(["ewif-jax", *argv]),
    )
    try:
        with jax.enable_x64(arguments.dtype == "float64"):
            if arguments.action == "track":
                from ewif_jax.study.track.command import track

                track(arguments, options)
            else:
                for study in STUDIES:
                    if arguments.name in (study.name, "all"):
                        study.load()(Experiment(study.name, options))
    except (Refused, OSError) as error:
        return _complain(str(error), 2)
    except KeyboardInterrupt:
        return _complain("stopped; the same command resumes what is finished", 130)
    return 0


def _complain(text: str, status: int) -> int:
    print(f"ewif-jax: {text}", file=sys.stderr)
    return status
