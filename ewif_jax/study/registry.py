"""The studies there are. A new one is one file with a function `run(experiment)`, and one line."""

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from ewif_jax.study.experiment import Experiment


class Study(NamedTuple):
    """name on the command line; help: one line; module: where its `run(experiment)` lives (it is
    imported only when the study runs)."""

    name: str
    help: str
    module: str

    def load(self) -> Callable[["Experiment"], None]:
        return import_module(self.module).run


STUDIES = (
    Study(
        "sine", "EWIF and Kalman filter on a noisy sine, tuned by gradient", "ewif_jax.study.sine"
    ),
    Study("gains", "how the weight of a late measurement decays", "ewif_jax.study.gains"),
    Study("random-walk", "late measurements up to a cut-off", "ewif_jax.study.random_walk"),
    Study("arrowhead", "late measurements under a wrong model", "ewif_jax.study.arrowhead"),
    Study("arrowhead-ekf", "the same with an extended filter", "ewif_jax.study.arrowhead_ekf"),
    Study(
        "arbitrary-target",
        "two sensors, one late: filter and smoother, animated",
        "ewif_jax.study.arbitrary_target",
    ),
    Study(
        "tuning-under-delay",
        "tau, q and the cut-off by gradient through late measurements",
        "ewif_jax.study.tuning_under_delay",
    ),
    Study(
        "two-bearings",
        "two rotating bearing sensors, one late: ensembles and particles",
        "ewif_jax.study.two_bearings",
    ),
    Study("turn", "particle filters, a fast turn and a late sensor", "ewif_jax.study.turn"),
    Study(
        "divergence",
        "data saturation, and what weighting does about it",
        "ewif_jax.study.divergence",
    ),
)
