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


def apart(fn: Callable[..., Any], *args: Any) -> Any:
    """`fn(*args)`, its arrays as NumPy's, from a process whose programs are compiled to run fast.
    `fn` must be a function of a module."""
    flags = os.environ.get("XLA_FLAGS", "").removesuffix(os.environ.get(FLAGS_OF_THE_TESTS, ""))
    with (
        patch.dict(os.environ, XLA_FLAGS=flags),
        ProcessPoolExecutor(1, get_context("spawn"), initializer=_strict) as pool,
    ):
        return pool.submit(_computed, fn, args).result()


def _strict() -> None:
    ej.prepare_cpu(1)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_rank_promotion", "raise")


def _computed(fn: Callable[..., Any], args: tuple) -> Any:
    return jax.device_get(fn(*args))
