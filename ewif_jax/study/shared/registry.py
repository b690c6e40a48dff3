"""The studies there are. A new one is one folder with a function `run(experiment)` in its
`study.py`, and one line."""

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from ewif_jax.study.shared.experiment import Experiment


class Study(NamedTuple):
    """name on the command line, and with underscores that of the folder in `study/papers`, which is
    imported only when the study runs; help: one line."""

    name: str
    help: str

    def load(self) -> Callable[["Experiment"], None]:
        """The function `run` of the study."""
        folder = self.name.replace("-", "_")
        return import_module(f"ewif_jax.study.papers.{folder}.study").run


STUDIES = (
    Study("sine", "EWIF and Kalman filter on a noisy sine, tuned by gradient"),
    Study("gains", "how the weight of a late measurement decays"),
    Study("random-walk", "late measurements up to a cut-off"),
    Study("arrowhead", "late measurements under a wrong model"),
    Study("arrowhead-ekf", "the same with an extended filter"),
    Study("arbitrary-target", "two sensors, one late: filter and smoother, animated"),
    Study("tuning-under-delay", "tau, q and the cut-off by gradient through late measurements"),
    Study("latency", "clocks that are off, calibrated from the data alone"),
    Study("manoeuvres", "EWIF, Kalman filter and interacting models on targets seen late"),
    Study("two-bearings", "two rotating bearing sensors, one late: ensembles and particles"),
    Study("turn", "particle filters, a fast turn and a late sensor"),
    Study("divergence", "data saturation, and what weighting does about it"),
)
