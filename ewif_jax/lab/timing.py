"""Compile time and run time, apart."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import jax


class Timing:
    """Seconds that a block spent compiling (tracing included) and doing everything else."""

    compile: float = 0.0
    run: float = 0.0


@contextmanager
def timed() -> Iterator[Timing]:
    """Measures the block; the `Timing` is filled in when it ends. What the block computes should
    be on the host by then (JAX runs ahead of Python)."""
    events = _compilation_spans()
    first, begin, timing = len(events), time.perf_counter(), Timing()
    try:
        yield timing
    finally:
        whole = time.perf_counter() - begin
        timing.compile = min(_covered_length(events[first:]), whole)
        timing.run = whole - timing.compile


@cache
def _compilation_spans() -> list[tuple[float, float]]:
    """(begin, end) of everything JAX has compiled since the first call."""
    events: list[tuple[float, float]] = []

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            now = time.perf_counter()
            events.append((now - duration_secs, now))

    jax.monitoring.register_event_duration_secs_listener(listen)
    return events


def _covered_length(intervals: list[tuple[float, float]]) -> float:
    """Length of the union: tracing one function inside another is counted once."""
    total, reached = 0.0, -float("inf")
    for begin, end in sorted(intervals):
        total += max(end - max(begin, reached), 0.0)
        reached = max(reached, end)
    return total
