"""One comparison by several processes of `jax.distributed`, on one machine or many.

Every process makes the same call. Units of work go round; each is computed by one process and sent
to all, so that all end with the same comparison. The first process alone keeps the folder.
"""

import io
from collections.abc import Callable, Iterable, Sequence

import jax
import numpy as np
from jax.experimental import multihost_utils

from ewif_jax.lab.engine import Unit
from ewif_jax.lab.store import Store
from ewif_jax.lab.units import Arrays


def are_several() -> bool:
    """Whether other processes make the same call."""
    return jax.process_count() > 1


def is_first() -> bool:
    """Whether this is the process that keeps the folder."""
    return jax.process_index() == 0


def share_units(
    units: Sequence[Unit],
    store: Store,
    compute: Callable[[Unit], Arrays],
    done: Callable[[Unit, Arrays], None],
) -> None:
    """Computes units that the first process has not kept from before, each in one process, and
    hands every unit to `done` in all of them."""
    kept = np.asarray([is_first() and store.has(unit.name) for unit in units])
    kept = np.asarray(multihost_utils.broadcast_one_to_all(kept))
    for unit in (u for u, is_kept in zip(units, kept, strict=True) if is_kept):
        own = store.read(unit.name) if is_first() else None
        found = next(iter(_exchanged_bytes(own)))
        if not is_first():
            done(unit, _decoded_arrays(found))
    left = [u for u, is_kept in zip(units, kept, strict=True) if not is_kept]
    count = jax.process_count()
    for begin in range(0, len(left), count):
        group = left[begin : begin + count]
        place = jax.process_index()
        own = compute(group[place]) if place < len(group) else None
        for unit, found in zip(group, _exchanged_bytes(own), strict=False):
            done(unit, _decoded_arrays(found))


def _exchanged_bytes(own: Arrays | None) -> Iterable[bytes]:
    """What each process sends, in their order."""
    data = b"" if own is None else _encoded_arrays(own)
    sizes = np.ravel(multihost_utils.process_allgather(np.asarray([len(data)], np.int32)))
    padded = np.zeros(int(sizes.max()), np.uint8)
    padded[: len(data)] = np.frombuffer(data, np.uint8)
    rows = np.asarray(multihost_utils.process_allgather(padded)).reshape(len(sizes), -1)
    return [row[:size].tobytes() for row, size in zip(rows, sizes, strict=True)]


def _encoded_arrays(arrays: Arrays) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def _decoded_arrays(data: bytes) -> Arrays:
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        return dict(stored)
