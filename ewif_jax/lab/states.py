"""A filter's state on disk."""

import json
import os
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ewif_jax import checks
from ewif_jax.lab.pieces import Broken, read_piece, write_piece
from ewif_jax.types import Numbers, State

FORMAT = 1


def save_state(path: str | os.PathLike[str], state: State) -> Path:
    """Writes a filter's state (of `init`, `step`, or `Trace.final_state`) to a file (npz); returns
    its path. The file is whole, or the earlier one stays.

    Args:
        path: of the file.
        state: a pytree of arrays.
    """
    leaves = jax.tree.leaves(state)
    arrays = {f"leaf{i}": _plain_leaf(x) for i, x in enumerate(leaves)}
    about = {"format": FORMAT, "version": version("ewif_jax"), "state": _described_leaves(state)}
    place = Path(path)
    write_piece(place, {**arrays, "about": np.asarray(json.dumps(about))})
    return place


def load_state(path: str | os.PathLike[str], like: State) -> Any:
    """The state that `save_state` wrote.

    Args:
        path: of the file.
        like: a state of the same filter (`estimator.init(params, prior, t0)`), which says what it
            has to look like.

    Raises:
        ValueError: a file that is not whole, of a later format, or of a state with other fields,
            shapes or dtypes, which are named.
        FileNotFoundError: no such file.
    """
    try:
        arrays = read_piece(Path(path))
        about = json.loads(str(arrays.pop("about")))
    except (Broken, KeyError, ValueError) as error:
        raise ValueError(f"path: expected a file of save_state, got {path}") from error
    checks.require(about["format"] <= FORMAT, "path", f"format {FORMAT}", about["format"])
    there, here = about["state"], _described_leaves(like)
    for name in (*here, *(name for name in there if name not in here)):
        same = there.get(name) == here.get(name)
        got = f"{there.get(name, 'nothing')} in {path}"
        checks.require(same, f"state{name}", here.get(name, "nothing"), got)
    leaves, structure = jax.tree.flatten(like)
    found = [_as_in(x, arrays[f"leaf{i}"]) for i, x in enumerate(leaves)]
    return jax.tree.unflatten(structure, found)


def _described_leaves(state: State) -> dict[str, str]:
    """Shape and dtype of each leaf, by its name."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path): f"{_dtype_of(x)}{list(np.shape(x))}" for path, x in leaves}


def _dtype_of(x: Numbers) -> str:
    return str(jax.numpy.result_type(x)) if not checks.is_typed_key(x) else str(x.dtype)


def _plain_leaf(x: Numbers) -> np.ndarray:
    return np.asarray(jax.random.key_data(x) if checks.is_typed_key(x) else x)


def _as_in(like: State, x: np.ndarray) -> Any:
    if checks.is_typed_key(like):
        return jax.random.wrap_key_data(jax.numpy.asarray(x), impl=jax.random.key_impl(like))
    return jax.numpy.asarray(x, jax.numpy.result_type(like))
