"""Who computes the units of work: this process, its devices, or an executor's workers."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from concurrent.futures import ThreadPoolExecutor as Threads
from functools import lru_cache
from queue import SimpleQueue
from typing import Any, NamedTuple

import jax
import numpy as np

from ewif_jax import checks
from ewif_jax.lab.design import Design
from ewif_jax.lab.store import Store
from ewif_jax.lab.units import Arrays, computed

IN_FLIGHT = 4
"""units for each worker that are sent ahead"""


class Unit(NamedTuple):
    """A chunk of runs at a point of the grid, both by number."""

    point: int
    chunk: int

    @property
    def name(self) -> str:
        """Its name in a store."""
        return f"p{self.point:05d}-c{self.chunk:07d}"


Tuned = Mapping[int, Mapping[str, Any]]
"""Tuned parameters, by point and method."""
Done = Callable[[Unit, Arrays], None]


def compute_units(
    design: Design,
    tuned: Tuned,
    units: Sequence[Unit],
    done: Done,
    executor: Executor | None,
    devices: int | None,
) -> None:
    """Computes units in any order, and hands each to `done` in this thread."""
    if not units:
        return
    local = jax.local_devices()[:devices]
    if executor is not None:
        _by_executor(design, tuned, units, done, executor)
    elif len(local) == 1 or len(units) == 1:
        for unit in units:
            done(unit, compute_unit(design, tuned, unit))
    else:
        _by_devices(design, tuned, units, done, local)


def compute_unit(design: Design, tuned: Tuned, unit: Unit) -> Arrays:
    """The arrays of a unit, computed here."""
    point = design.points[unit.point]
    return computed(design, point, unit.chunk, tuned.get(unit.point, {}))


def _by_devices(
    design: Design, tuned: Tuned, units: Sequence[Unit], done: Done, local: Sequence[Any]
) -> None:
    free: SimpleQueue[Any] = SimpleQueue()
    for device in local:
        free.put(device)

    def on_a_device(unit: Unit) -> Arrays:
        device = free.get()
        try:
            with jax.default_device(device):
                return compute_unit(design, tuned, unit)
        finally:
            free.put(device)

    # Settings of JAX that a caller made for a while (`jax.enable_x64`) are of this thread alone.
    x64 = bool(jax.config.jax_enable_x64)  # pyright: ignore

    def in_a_thread(unit: Unit) -> Arrays:
        with jax.enable_x64(x64):
            return on_a_device(unit)

    with Threads(len(local)) as threads:
        for unit, found in _as_they_come(threads.submit, in_a_thread, units, 2 * len(local)):
            done(unit, found)


def _by_executor(
    design: Design, tuned: Tuned, units: Sequence[Unit], done: Done, executor: Executor
) -> None:
    _refuse_fork(executor)
    workers = getattr(executor, "_max_workers", 32)
    x64 = bool(jax.config.jax_enable_x64)  # pyright: ignore
    if isinstance(executor, Threads):
        found = _as_they_come(
            executor.submit,
            lambda unit: compute_unit(design, tuned, unit),
            units,
            IN_FLIGHT * workers,
        )
        for unit, arrays in found:
            done(unit, arrays)
        return
    import cloudpickle

    key = (
        np.asarray(jax.random.key_data(design.key))
        if checks.is_typed_key(design.key)
        else design.key
    )
    implementation = (
        str(jax.random.key_impl(design.key)) if checks.is_typed_key(design.key) else None
    )
    # Once for all units: workers keep the unpacked design, and with it what they have compiled for
    # it, as long as the bytes are equal.
    job = cloudpickle.dumps((design._replace(key=key), dict(tuned), implementation, x64))
    left = dict.fromkeys(units)
    try:
        for unit, arrays in _as_they_come(
            lambda work, unit: executor.submit(work, job, tuple(unit)),
            remote,
            units,
            IN_FLIGHT * workers,
        ):
            done(unit, arrays)
            del left[unit]
    except BrokenExecutor as error:
        # An executor whose worker died takes no more work. What was lost is computed here: the same
        # unit gives the same numbers wherever it runs.
        warnings.warn(
            f"executor: a worker died ({error}); the {len(left)} units that are left are computed "
            "in this process",
            RuntimeWarning,
            stacklevel=4,
        )
        for unit in left:
            done(unit, compute_unit(design, tuned, unit))


def _as_they_come(
    submit: Callable[..., Future], work: Any, units: Sequence[Unit], most: int
) -> Iterator[tuple[Unit, Arrays]]:
    """(unit, its arrays), with at most `most` of them on their way, so that memory stays flat."""
    waiting: dict[Future, Unit] = {}
    ahead = iter(units)
    try:
        while True:
            while len(waiting) < most and (unit := next(ahead, None)) is not None:
                waiting[submit(work, unit)] = unit
            if not waiting:
                return
            ready, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in ready:
                yield waiting.pop(future), future.result()
    finally:
        for future in waiting:
            future.cancel()


def remote(job: bytes, unit: tuple[int, int]) -> Arrays:
    """A unit, in a worker."""
    design, tuned, x64 = _unpacked_job(job)
    with jax.enable_x64(x64):
        return compute_unit(design, tuned, Unit(*unit))


@lru_cache(maxsize=2)
def _unpacked_job(job: bytes) -> tuple[Design, Tuned, bool]:
    """The design, unpacked once in each worker: what was compiled for it is used again."""
    import pickle

    design, tuned, implementation, x64 = pickle.loads(job)
    if implementation is not None:
        key = jax.random.wrap_key_data(design.key, impl=implementation)
        design = design._replace(key=key)
    return design, tuned, x64


def _refuse_fork(executor: Executor) -> None:
    """JAX has threads, and a process that is forked from one with threads may wait forever."""
    context = getattr(executor, "_mp_context", None)
    if context is not None and context.get_start_method() == "fork":
        raise ValueError(
            "executor: expected processes that do not fork, got start method 'fork', which JAX "
            "cannot stand (ProcessPoolExecutor(2, mp_context=multiprocessing.get_context('spawn')))"
        )


def not_there(store: Store, units: Sequence[Unit]) -> list[Unit]:
    """Those that are not in the store yet."""
    return [unit for unit in units if not store.has(unit.name)]
