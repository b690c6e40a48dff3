"""The laboratory: a study of one's own, from tables to pictures.

`compare` runs methods on the same simulated runs over a grid of parameters and gives a `Comparison`
with tables, labelled arrays, figures and a report. `from_frame`, `to_frame` and `to_xarray` are the
way in and out, `plots` draws filters and data, `save_state` and `load_state` keep a filter.
`adapters` takes filters over from FilterPy, pykalman and dynamax.
"""

from ewif_jax.lab import adapters, plots
from ewif_jax.lab.arrays import to_frame, to_xarray
from ewif_jax.lab.compare import compare
from ewif_jax.lab.comparison import Comparison
from ewif_jax.lab.design import Limits
from ewif_jax.lab.frames import Frame, from_frame
from ewif_jax.lab.methods import Method, Tuning, axis
from ewif_jax.lab.parametric import parametric
from ewif_jax.lab.states import load_state, save_state

__all__ = [
    "Comparison",
    "Frame",
    "Limits",
    "Method",
    "Tuning",
    "adapters",
    "axis",
    "compare",
    "from_frame",
    "load_state",
    "parametric",
    "plots",
    "save_state",
    "to_frame",
    "to_xarray",
]
