"""The loop over the arrivals of one run made one of many: in groups, what they share ahead."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax.fast.blocks import Place, Portion, scan_in_blocks
from ewif_jax.fast.dependence import Divided, Traced, dependence, divided, traced
from ewif_jax.fast.groups import (
    block_size,
    goes_together,
    group_size,
    in_groups,
)
from ewif_jax.fast.layout import (
    joined,
    one_run,
    parted,
    runs_adjacent,
    runs_first,
    vmap_last,
)
from ewif_jax.types import Numbers, Params, PyTree, RandomKey, State


class Loop(NamedTuple):
    """The scan of one run."""

    start: Callable[[Any, Any, Any], Any]
    """(params, prior, key) -> state."""
    step: Callable[[Any, Any, Any], tuple[Any, Any]]
    """(params, state, arrival) -> state, what is observed of it."""


class Inputs(NamedTuple):
    """What goes into the runs; or, in the same places, which leaves have a leading axis of runs."""

    params: Any
    measurements: Any
    prior: Any
    times: Any
    keys: Any
    context: Any

    @property
    def first(self) -> tuple[Any, Any, Any]:
        """What the first state is made of."""
        return self.params, self.prior, self.keys

    @property
    def arrivals(self) -> tuple[Any, Any, Any]:
        """What arrives, stacked over the steps."""
        return self.measurements, self.times, self.context


class OneRun(NamedTuple):
    """The loop of one run as equations, and which leaves of its states, and of what is observed,
    differ by run."""

    start: Traced
    step: Traced
    state_differs: Any
    seen_differs: Any

    @property
    def differ(self) -> tuple[Any, Any]:
        """Both."""
        return self.state_differs, self.seen_differs


def over_runs(
    loop: Loop, estimate: Callable[[Any, Any], Any], inputs: PyTree, flags: PyTree
) -> tuple[Any, Any]:
    """What is observed (R, T, ...) and the final states (R, ...).

    Args:
        loop: of one run.
        estimate: (params, state) -> estimate, for its size.
        inputs: the fields of `Inputs`.
        flags: which of their leaves have a leading axis of runs.
    """
    inputs, per_run = Inputs(*inputs), Inputs(*flags)
    single = jax.eval_shape(lambda inputs: one_run(inputs, per_run), inputs)
    run = _traced_run(loop, single, per_run)
    levels = (
        _input_levels(per_run.params, 0),
        _input_levels(run.state_differs, 1),
        _input_levels(per_run.arrivals, 1),
    )
    parts = divided(run.step, levels, run.differ)
    runs, _, m = inputs.measurements.value.shape
    # What all share is stored for every arrival: only if that takes no more than the values do.
    ahead = 0 < parts.needed <= runs * m * inputs.measurements.value.dtype.itemsize
    shown = jax.eval_shape(estimate, single.params, run.start.outputs)
    portion = _portion_of(run, shown, per_run, inputs.measurements.value, ahead)
    if ahead and 1 < portion.runs < runs:
        return _shared_ahead(loop, parts, inputs, per_run, run.differ, portion)
    return _in_groups(loop, inputs, per_run, run.differ, portion)


def _traced_run(loop: Loop, single: Inputs, per_run: Inputs) -> OneRun:
    start = traced(loop.start, *single.first)
    arrival = jax.eval_shape(_first_arrival, single.arrivals)
    step = traced(loop.step, single.params, start.outputs, arrival)
    state_differs = dependence(start, per_run.first)
    differ = _that_differ(step, per_run.params, state_differs, per_run.arrivals)
    return OneRun(start, step, *differ)


def _portion_of(run: OneRun, shown: PyTree, per_run: Inputs, value: Array, ahead: bool) -> Portion:
    """How many runs and steps at a time, for an estimate of such a size."""
    runs, steps, _ = value.shape
    own, shared, largest = _byte_sizes(run.start.outputs, run.state_differs, shown)
    # Whether a filter draws is read off its equations: only the key is taken as different by run,
    # and what then differs in the first state holds random members.
    of_key = dependence(
        run.start,
        per_run._replace(
            params=_all_shared(per_run.params), prior=_all_shared(per_run.prior)
        ).first,
    )
    draws = any(jax.tree.leaves(of_key))
    together = goes_together(run.step)
    kept = 0 if ahead else shared
    # What all share is no part of a group's memory once it has been computed ahead.
    size = group_size(runs, own, kept, largest, value.dtype.itemsize, together, draws)
    seen = parted(run.step.outputs[1], run.seen_differs)[0]
    block = block_size(steps, size * sum(x.size * x.dtype.itemsize for x in seen), together)
    return Portion(size, block, together)


def _that_differ(
    step: Traced, params_f: PyTree, state_f: PyTree, arrival_f: PyTree
) -> tuple[Any, Any]:
    """Which leaves of the state, and of what is observed, differ by run (pytrees of bools)."""
    # A fixed point: a leaf of the state that differs after a step makes others differ in the next.
    # Flags only ever turn True, so it ends after at most as many rounds as there are leaves.
    while True:
        later_f, seen_f = dependence(step, (params_f, state_f, arrival_f))
        either = jax.tree.map(lambda a, b: a or b, state_f, later_f)
        if either == state_f:
            return state_f, seen_f
        state_f = either


def _input_levels(flags: PyTree, shared: int) -> Any:
    return jax.tree.map(lambda f: 2 if f else shared, flags)


def _first_arrival(arrivals: PyTree) -> Any:
    return jax.tree.map(lambda x: x[0], arrivals)


def _byte_sizes(state: State, state_f: PyTree, shown: PyTree) -> tuple[int, int, int]:
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
    inputs: Inputs,
    per_run: Inputs,
    differ: tuple[PyTree, PyTree],
    portion: Portion,
) -> tuple[Any, Any]:
    """What all runs share is computed first, once for all groups, which then read what they need
    of it at each arrival."""
    state_differs, seen_differs = differ
    runs, steps = inputs.measurements.value.shape[:2]

    @partial(jax.checkpoint, prevent_cse=False)
    def step_ahead(state: list[Array], arrival: list[Array]) -> tuple[Any, Any]:
        shared_params = parted(inputs.params, per_run.params)[1]
        outputs, needed = parts.ahead([*shared_params, *state, *arrival])
        return outputs[: len(state)], (outputs[len(state) :], needed)

    state = parted(loop.start(*one_run(inputs.first, per_run.first)), state_differs)[1]
    arrivals = parted(inputs.arrivals, per_run.arrivals)[1]
    # This loop runs once for the whole batch; for `kalman` with common times it holds the
    # covariances and gains, and what is left for the groups is the means.
    last, (seen, needed) = lax.scan(step_ahead, state, arrivals, steps)

    def start(params: Params, prior: PyTree, key: RandomKey) -> Any:
        return parted(loop.start(params, prior, key), state_differs)[0]

    def step(params: Params, state: list[Array], arrival: Numbers) -> tuple[Any, Any]:
        measurement, time, (seen, needed) = arrival
        own = parted((measurement, time, seen), per_run.arrivals)[0]
        outputs = parts.rest([*jax.tree.leaves(params), *state, *own], needed)
        return outputs[: len(state)], outputs[len(state) :]

    found = _in_groups(
        Loop(start, step),
        inputs._replace(context=(inputs.context, needed)),
        per_run._replace(context=(per_run.context, [False] * len(needed))),
        tuple([f for f in jax.tree.leaves(tree) if f] for tree in differ),
        portion,
    )
    for_all = [[jnp.broadcast_to(x, (runs, *x.shape)) for x in shared] for shared in (seen, last)]
    return (
        joined(found[0], for_all[0], seen_differs),
        joined(found[1], for_all[1], state_differs),
    )


def _in_groups(
    loop: Loop, inputs: Inputs, per_run: Inputs, differ: Sequence[PyTree], portion: Portion
) -> tuple[Any, Any]:
    alone = _all_shared((per_run, differ))

    def group(inputs: Inputs, place: Place | None) -> tuple[Any, Any]:
        flags, differ_inside = (per_run, differ) if portion.runs > 1 else alone
        return _scanned_group(loop, inputs, flags, differ_inside, portion, place)

    return in_groups(group, inputs, per_run, inputs.measurements.value.shape[0], portion)


def _all_shared(flags: PyTree) -> Any:
    return jax.tree.map(lambda _: False, flags)


def _scanned_group(
    loop: Loop,
    inputs: Inputs,
    per_run: Inputs,
    differ: Sequence[PyTree],
    portion: Portion,
    place: Place | None,
) -> tuple[Any, Any]:
    """The same from inputs with the runs last."""
    runs = portion.runs
    state_differs, seen_differs = differ
    start = vmap_last(loop.start, per_run.first, state_differs, runs)
    flags = per_run.params, state_differs, per_run.arrivals
    step = vmap_last(loop.step, flags, (state_differs, seen_differs), runs)

    # The layout is asked for on both sides of a step: XLA may choose another one for the carry of a
    # loop and turn the state around at each step.
    def arrive(state: State, arrival: Numbers) -> tuple[Any, Any]:
        state, seen = step(inputs.params, runs_adjacent(state, state_differs), arrival)
        return runs_adjacent(state, state_differs), seen

    seen, state = scan_in_blocks(
        arrive,
        start(*inputs.first),
        inputs.arrivals,
        lambda seen: runs_first(seen, seen_differs, runs),
        portion,
        place,
    )
    return seen, runs_first(state, state_differs, runs)
