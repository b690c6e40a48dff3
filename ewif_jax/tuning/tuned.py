"""What tuning found, and why it ended."""

from typing import NamedTuple

import jax
import numpy as np

from ewif_jax.types import Params, PyTree


class Tuned(NamedTuple):
    """The best parameters seen, and how they were found; prints as a small table.

    params: the best seen; with `validation` those with the least held-out loss; of a sampled loss
        the last.
    loss: () their loss, with the penalty.
    history: of every evaluation, in their order: loss (steps,), and params (steps, ...) where it
        was evaluated; with `validation` also the held-out loss (NaN where it was not asked for).
        After the end of the search the best is repeated, up to `steps`.
    reason: why it ended. It begins with "converged", "at a bound", "out of steps", "validation" or
        "not finite".
    gradient_norm: the length of the gradient there, in the free numbers (a logarithm for what is
        positive).
    transforms: the name of each leaf's transform, "fixed" if it stood still.
    method: how it was done.
    evaluations: how often the loss and its gradient were evaluated: from all starts together, and
        to find the domain.
    starts: what was found from each starting point, if there were many.
    """

    params: Params
    loss: float
    history: dict[str, PyTree]
    reason: str = ""
    gradient_norm: float = float("nan")
    transforms: PyTree = None
    method: str = ""
    evaluations: int = 0
    starts: tuple["Tuned", ...] = ()

    @property
    def converged(self) -> bool:
        """Whether it ended at a least value, inside of the domain."""
        return self.reason.startswith("converged")

    def __repr__(self) -> str:
        paths = jax.tree.leaves_with_path(self.params)
        names = jax.tree.leaves(self.transforms) or [""] * len(paths)
        first = [x[0] for x in jax.tree.leaves(self.history["params"])]
        rows = [("parameter", "start", "tuned", "moves")]
        for (path, leaf), name, start in zip(paths, names, first, strict=True):
            label = jax.tree_util.keystr(path, simple=True, separator=".") or "params"
            rows.append((label, _short_text(start), _short_text(leaf), name))
        wide = [max(len(row[k]) for row in rows) for k in range(4)]
        lines = ["  ".join(x.ljust(w) for x, w in zip(row, wide, strict=True)) for row in rows]
        ends = f"loss {self.history['loss'][0]:.6g} -> {self.loss:.6g}, "
        ends += f"gradient {self.gradient_norm:.1e}, {self.evaluations} evaluations ({self.method})"
        return "\n".join([*(line.rstrip() for line in lines), ends, self.reason])


def _short_text(x: object) -> str:
    value = np.asarray(x)
    if value.size > 4:
        return f"{value.dtype}{list(value.shape)}"
    return np.array2string(value, precision=5, separator=", ").replace("\n", "")
