"""Compiling as hard as the work that is to be done deserves."""

import os
from collections.abc import Callable, Mapping
from functools import cache, wraps
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.errors import JaxRuntimeError

QUICK: Mapping[str, Any] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": os.cpu_count() or 1,
}
"""Half the compile time. Small arrays are computed no slower, long ones at down to a quarter of the
speed. A program is cut into no more parts than can be compiled at the same time."""

QUICKEST: Mapping[str, Any] = {**QUICK, "xla_backend_optimization_level": 0}
"""Half of that or less. Small arrays take up to 3 times as long, long ones up to 10 times."""


def quick_jit(fn: Callable[..., Any], static_argnames: Any, options: Mapping[str, Any]) -> Any:
    """`jax.jit`, with these options on a CPU, where this XLA knows them and nothing is transformed
    (a program inside another cannot have its own)."""
    plain = jax.jit(fn, static_argnames=static_argnames)
    quick = jax.jit(fn, static_argnames=static_argnames, compiler_options=dict(options))

    @wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        # The zero is a tracer if a surrounding program is being traced, whatever comes in.
        leaves = (jnp.zeros(()), *jax.tree.leaves((args, kwargs)))
        inner = any(isinstance(x, Tracer) for x in leaves)
        return (plain if inner or not _known() else quick)(*args, **kwargs)

    return call


@cache
def _known() -> bool:
    if jax.default_backend() != "cpu":
        return False
    try:
        jax.jit(lambda: 0, compiler_options=dict(QUICKEST))()
    except JaxRuntimeError:
        return False
    return True
