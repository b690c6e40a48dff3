"""Computations that run for longer than they take to compile."""

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any
from unittest.mock import patch

import jax

import ewif_jax as ej

FLAGS_OF_THE_TESTS = "EWIF_JAX_TESTS_XLA_FLAGS"
"""What `conftest` added to XLA_FLAGS, for this to leave it out."""

SOON_FAST = (
    " --xla_backend_optimization_level=1 --xla_cpu_use_fusion_emitters=false"
    " --xla_cpu_parallel_codegen_split_count=1"
)
"""Two thirds of the time to compile that XLA takes by default, for programs that run as fast."""


def apart(fn: Callable[..., Any], *args: Any, double: bool = True) -> Any:
    """`fn(*args)`, its arrays as NumPy's, from a process whose programs are compiled to run fast,
    in double precision or in single. `fn` must be a function of a module."""
    added = os.environ.get(FLAGS_OF_THE_TESTS, "")
    flags = os.environ.get("XLA_FLAGS", "").removesuffix(added) + soon_fast(added)
    with (
        patch.dict(os.environ, XLA_FLAGS=flags),
        ProcessPoolExecutor(1, get_context("spawn"), _strict, (double,)) as pool,
    ):
        return pool.submit(_computed, fn, args).result()


def soon_fast(added: str) -> str:
    """The flags of `SOON_FAST` that are among those the tests `added`, if with other values."""
    return "".join(f" {x}" for x in SOON_FAST.split() if x.partition("=")[0] in added)


def _strict(double: bool) -> None:
    ej.prepare_cpu(1)
    jax.config.update("jax_enable_x64", double)
    jax.config.update("jax_numpy_rank_promotion", "raise")


def _computed(fn: Callable[..., Any], args: tuple) -> Any:
    return jax.device_get(fn(*args))
