"""What can be written on the command line."""

import argparse
import math
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from ewif_jax.study.shared.registry import STUDIES

MODELS = ("random-walk", "constant-velocity", "constant-acceleration")
ESTIMATORS = ("ewif", "kalman", "information", "square-root", "fading", "al1", "asd")
LOSSES = ("median", "robust", "squared", "likelihood")


def parser() -> argparse.ArgumentParser:
    """The parser of `ewif-jax`; `action` tells the two commands apart."""
    top = argparse.ArgumentParser(
        prog="ewif-jax", description="Filtering with late measurements, tuned by gradient."
    )
    top.add_argument("--version", action="version", version=f"ewif-jax {version('ewif_jax')}")
    commands = top.add_subparsers(dest="action", required=True, metavar="COMMAND")
    _study_options(commands.add_parser("study", help="repeat a published experiment"))
    _track_options(
        commands.add_parser("track", help="filter your own measurements from a CSV file")
    )
    return top


def _common_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("common options")
    group.add_argument("--seed", type=seed_argument, default=0, help="of the random numbers (0)")
    group.add_argument("--out", type=Path, default=Path("results"), help="folder (results)")
    group.add_argument(
        "--overwrite", action="store_true", help="replace earlier results instead of keeping them"
    )
    group.add_argument("--dtype", choices=("float64", "float32"), default="float64")


def _study_options(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    lines = [f"  {study.name:20}{study.help}" for study in STUDIES]
    parser.description = "\n".join(["Studies:", *lines, f"  {'all':20}all of them"])
    parser.add_argument("name", choices=[*(s.name for s in STUDIES), "all"], metavar="NAME")
    parser.add_argument(
        "--runs", type=whole_argument(2), help="simulated runs (the study's own choice)"
    )
    parser.add_argument("--quick", action="store_true", help="small, to see that it works")
    parser.add_argument("--chunk", type=whole_argument(1), help="runs in memory at once (1024)")
    _common_options(parser)


def _track_options(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Runs a filter over the measurements in a CSV file, all tracks in one batch, and tells "
        "how well each measurement is predicted from the earlier ones."
    )
    parser.set_defaults(runs=None, quick=False, chunk=None)
    parser.add_argument("file", type=Path, metavar="FILE.csv")
    columns = parser.add_argument_group(
        "columns (guessed where not given; none: there is no such column)"
    )
    columns.add_argument("--time", metavar="COL", help="when the value was true, seconds")
    columns.add_argument(
        "--arrival", metavar="COL", help="when it arrived or was reported, seconds"
    )
    columns.add_argument("--track", metavar="COL", help="which object")
    columns.add_argument("--sensor", metavar="COL", help="which sensor")
    where = columns.add_mutually_exclusive_group()
    where.add_argument("--values", metavar="X,Y", type=names_argument, help="position, in metres")
    where.add_argument(
        "--latlon", metavar="LAT,LON", type=names_argument, help="position, in degrees"
    )
    columns.add_argument("--date", metavar="COL", help="of the days, where --time has times of day")
    columns.add_argument("--decimal", choices=(".", ","), help="mark of decimals (what it shows)")
    columns.add_argument(
        "--dates", choices=("day-first", "month-first"), help="03/04/2024 (what the file shows)"
    )
    columns.add_argument(
        "--drop-stale", action="store_true", help="drop rows that repeat the last value of a track"
    )
    columns.add_argument(
        "--min-points", type=whole_argument(1), default=1, help="leave out shorter tracks (1)"
    )
    method = parser.add_argument_group("method")
    method.add_argument("--model", choices=MODELS, default="constant-velocity")
    method.add_argument("--estimator", choices=ESTIMATORS, default="ewif")
    method.add_argument(
        "--noise",
        type=noise_argument,
        default={"": 1.0},
        metavar="M",
        help="measurement standard deviation in metres: 30, or radar=30,gps=5 (1)",
    )
    method.add_argument("--tau", type=positive, help="decay of the ewif, seconds")
    method.add_argument("--q", type=positive, help="process noise (m^2/s, m^2/s^3, m^2/s^5)")
    method.add_argument(
        "--fading", type=above_argument(1), help="Anderson's alpha per step, above 1"
    )
    method.add_argument(
        "--lag",
        type=whole_argument(1),
        default=4,
        help="past times al1, or measurements asd, keeps (4)",
    )
    method.add_argument(
        "--gate",
        type=probability_argument,
        metavar="P",
        help="refuse what is outside of a chi-square gate of this probability (0.999), until five "
        "in a row were",
    )
    method.add_argument(
        "--robust",
        type=positive,
        metavar="C",
        help="weigh down what is more than about C (2 to 5) noise standard deviations off",
    )
    tuning = parser.add_argument_group("tuning")
    tuning.add_argument("--tune", action="store_true", help="tau, q or fading, by gradient")
    tuning.add_argument(
        "--loss",
        choices=LOSSES,
        default="median",
        help="of the prediction errors: their median, mean length (robust), "
        "root mean square, or the likelihood",
    )
    tuning.add_argument(
        "--steps", type=whole_argument(1), default=200, help="evaluations, at most (200)"
    )
    tuning.add_argument(
        "--warm-up", type=whole_argument(0), default=5, help="first rows of a track not scored (5)"
    )
    _common_options(parser)


def whole_argument(least: int) -> Callable[[str], int]:
    """Reads a whole number >= `least`."""

    def read(text: str) -> int:
        if not text.isascii() or not text.removeprefix("-").isdigit() or int(text) < least:
            raise argparse.ArgumentTypeError(f"expected a whole number >= {least}, got {text!r}")
        return int(text)

    return read


def above_argument(bound: float) -> Callable[[str], float]:
    """Reads a finite number > `bound`."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (bound < value < math.inf):
            raise argparse.ArgumentTypeError(f"expected a number above {bound}, got {text!r}")
        return value

    return read


positive = above_argument(0)


def probability_argument(text: str) -> float:
    """Reads a number above 0 and below 1."""
    value = positive(text)
    if value >= 1:
        raise argparse.ArgumentTypeError(f"expected a number below 1, got {text!r}")
    return value


def seed_argument(text: str) -> int:
    """Reads a seed: what every generator of random numbers takes."""
    number = whole_argument(0)(text)
    if number >= 2**32:
        raise argparse.ArgumentTypeError(f"expected a whole number below 2**32, got {text!r}")
    return number


def names_argument(text: str) -> list[str]:
    """Reads column names separated by commas."""
    return [name.strip() for name in text.split(",")]


def noise_argument(text: str) -> dict[str, float]:
    """Reads one standard deviation (under the name ""), or name=value pairs by sensor."""
    if "=" not in text:
        return {"": positive(text)}
    pairs = (part.partition("=") for part in text.split(","))
    return {name.strip(): positive(value.strip()) for name, _, value in pairs}
