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
)
