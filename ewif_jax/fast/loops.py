"""The loop over the arrivals of one run made one of many: in groups, what they share ahead."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax.fast.dependence import Divided, Traced, dependence, divided, traced
from ewif_jax.fast.groups import (
    Place,
    Portion,
    block_size,
    goes_together,
    group_size,
    in_groups,
    scan_in_blocks,
)
from ewif_jax.fast.layout import (
    joined,
    one_run,
    parted,
    runs_adjacent,
    runs_first,
    vmap_last,
)


class Loop(NamedTuple):
    """The scan of one run."""

    start: Callable[[Any, Any, Any], Any]
    """(params, prior, key) -> state."""
    step: Callable[[Any, Any, Any], tuple[Any, Any]]
    """(params, state, arrival) -> state, what is observed of it."""


def over_runs(
    loop: Loop, estimate: Callable[[Any, Any], Any], inputs: Any, flags: Any
) -> tuple[Any, Any]:
    """What is observed (R, T, ...) and the final states (R, ...).

    Args:
        loop: of one run.
        estimate: (params, state) -> estimate, for its size.
        inputs: params, measurements, prior, times, keys, context.
        flags: which of their leaves have a leading axis of runs.
    """
    params, measurements, prior, times, key, context = jax.eval_shape(
        lambda inputs: one_run(inputs, flags), inputs
    )
    params_f, measurements_f, prior_f, times_f, key_f, context_f = flags
    start = traced(loop.start, params, prior, key)
    state, state_f = start.outputs, dependence(start, (params_f, prior_f, key_f))
    arrival = jax.eval_shape(_first, (measurements, times, context))
    arrival_f = measurements_f, times_f, context_f
    step = traced(loop.step, params, state, arrival)
    differ = _that_differ(step, params_f, state_f, arrival_f)
    levels = _levels(params_f, 0), _levels(differ[0], 1), _levels(arrival_f, 1)
    parts = divided(step, levels, differ)
    runs, steps, m = inputs[1].value.shape
    dtype = inputs[1].value.dtype
    ahead = 0 < parts.needed <= runs * m * dtype.itemsize  # no more memory than the values
    own, shared, largest = _sizes(state, differ[0], jax.eval_shape(estimate, params, state))
    of_key = dependence(start, (_alike(params_f), _alike(prior_f), key_f))
    draws = any(jax.tree.leaves(of_key))
    together = goes_together(step)
    size = group_size(runs, own, 0 if ahead else shared, largest, dtype.itemsize, together, draws)
    shown = parted(step.outputs[1], differ[1])[0]
    block = block_size(steps, size * sum(x.size * x.dtype.itemsize for x in shown), together)
    portion = Portion(size, block, together)
    if ahead and 1 < size < runs:
        return _shared_ahead(loop, parts, inputs, flags, differ, portion)
    return _in_groups(loop, inputs, flags, differ, portion)


def _that_differ(step: Traced, params_f: Any, state_f: Any, arrival_f: Any) -> tuple[Any, Any]:
    """Which leaves of the state, and of what is observed, differ by run (pytrees of bools)."""
    while True:
        later_f, seen_f = dependence(step, (params_f, state_f, arrival_f))
        either = jax.tree.map(lambda a, b: a or b, state_f, later_f)
        if either == state_f:
            return state_f, seen_f
        state_f = either


def _levels(flags: Any, shared: int) -> Any:
    return jax.tree.map(lambda f: 2 if f else shared, flags)


def _first(arrivals: Any) -> Any:
    return jax.tree.map(lambda x: x[0], arrivals)


def _sizes(state: Any, state_f: Any, shown: Any) -> tuple[int, int, int]:
    """The bytes of a run's own state, of the state that all share, and of the largest array in one
    or in an estimate."""
    sizes, estimated = (
        [x.size * x.dtype.itemsize for x in jax.tree.leaves(tree)] for tree in (state, shown)
    )
    own = sum(x for x, f in zip(sizes, jax.tree.leaves(state_f), strict=True) if f)
    return own, sum(sizes) - own, max(*sizes, *estimated)


def _shared_ahead(
    loop: Loop,
    parts: Divided,
    inputs: Any,
    flags: Any,
    differ: tuple[Any, Any],
    portion: Portion,
) -> tuple[Any, Any]:
    """What all runs share is computed first, once for all groups, which then read what they need
    of it at each arrival."""
    params, measurements, prior, times, keys, context = inputs
    params_f, measurements_f, prior_f, times_f, keys_f, context_f = flags
    state_f, seen_f = differ
    arrival_f = measurements_f, times_f, context_f
    runs, steps = measurements.value.shape[:2]

    @partial(jax.checkpoint, prevent_cse=False)
    def step_ahead(state: list[Array], arrival: list[Array]) -> tuple[Any, Any]:
        outputs, needed = parts.ahead([*parted(params, params_f)[1], *state, *arrival])
        return outputs[: len(state)], (outputs[len(state) :], needed)

    first = one_run((params, prior, keys), (params_f, prior_f, keys_f))
    state = parted(loop.start(*first), state_f)[1]
    arrivals = parted((measurements, times, context), arrival_f)[1]
    last, (seen, needed) = lax.scan(step_ahead, state, arrivals, steps)

    def start(params: Any, prior: Any, key: Any) -> Any:
        return parted(loop.start(params, prior, key), state_f)[0]

    def step(params: Any, state: list[Array], arrival: Any) -> tuple[Any, Any]:
        measurement, time, (seen, needed) = arrival
        own = parted((measurement, time, seen), arrival_f)[0]
        outputs = parts.rest([*jax.tree.leaves(params), *state, *own], needed)
        return outputs[: len(state)], outputs[len(state) :]

    found = _in_groups(
        Loop(start, step),
        (params, measurements, prior, times, keys, (context, needed)),
        (*flags[:-1], (context_f, [False] * len(needed))),
        tuple([f for f in jax.tree.leaves(tree) if f] for tree in differ),
        portion,
    )
    for_all = [[jnp.broadcast_to(x, (runs, *x.shape)) for x in shared] for shared in (seen, last)]
    return joined(found[0], for_all[0], seen_f), joined(found[1], for_all[1], state_f)


def _in_groups(
    loop: Loop, inputs: Any, flags: Any, differ: Sequence[Any], portion: Portion
) -> tuple[Any, Any]:
    same = _alike((flags, differ))

    def group(inputs: Any, place: Place | None) -> tuple[Any, Any]:
        inside, differ_inside = (flags, differ) if portion.runs > 1 else same
        return _scanned(loop, inputs, inside, differ_inside, portion, place)

    return in_groups(group, inputs, flags, inputs[1].value.shape[0], portion)


def _alike(flags: Any) -> Any:
    return jax.tree.map(lambda _: False, flags)


def _scanned(
    loop: Loop,
    inputs: Any,
    flags: Any,
    differ: Sequence[Any],
    portion: Portion,
    place: Place | None,
) -> tuple[Any, Any]:
    """The same from inputs with the runs last."""
    runs = portion.runs
    params, measurements, prior, times, keys, context = inputs
    params_f, measurements_f, prior_f, times_f, keys_f, context_f = flags
    state_f, seen_f = differ
    arrival_f = measurements_f, times_f, context_f
    start = vmap_last(loop.start, (params_f, prior_f, keys_f), state_f, runs)
    step = vmap_last(loop.step, (params_f, state_f, arrival_f), differ, runs)

    def arrive(state: Any, arrival: Any) -> tuple[Any, Any]:
        state, seen = step(params, runs_adjacent(state, state_f), arrival)
        return runs_adjacent(state, state_f), seen

    seen, state = scan_in_blocks(
        arrive,
        start(params, prior, keys),
        (measurements, times, context),
        lambda seen: runs_first(seen, seen_f, runs),
        portion,
        place,
    )
    return seen, runs_first(state, state_f, runs)
