"""Compiling as hard as the work that is to be done deserves."""

import ctypes
import os
import sys
from collections.abc import Callable, Mapping
from functools import cache, wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.errors import JaxRuntimeError
from jax.extend.core import get_opaque_trace_state

from ewif_jax import checks
from ewif_jax.fast.cache import keep_programs
from ewif_jax.plain import native
from ewif_jax.types import DTypeLike, Numbers

QUICK: Mapping[str, Any] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": os.cpu_count() or 1,
}
"""Half the compile time. Small arrays are computed no slower, long ones at down to a quarter of the
speed. A program is cut into no more parts than can be compiled at the same time."""

QUICKEST: Mapping[str, Any] = {**QUICK, "xla_backend_optimization_level": 0}
"""Half of that or less. Small arrays take up to 3 times as long, long ones up to 10 times."""

WIDE: Mapping[str, Any] = {"xla_cpu_prefer_vector_width": 512}
"""Vectors as long as the CPU has. By default XLA prefers 256 bits; loops over runs take up to a
quarter longer with them."""


_OPTIONS = "--xla_backend_extra_options"
_WHOLE_LOOPS = "xla_cpu_small_while_loop_byte_threshold"
WHOLE_LOOPS_BELOW = 1_500_000
"""Bytes that a round of the loop reads and writes: less than the loop over blocks of a large batch,
whose results are laid out faster by several threads."""


def prepare_cpu(
    devices: int | None = None, *, cache: bool | str | os.PathLike[str] = False
) -> None:
    r"""Makes this process fast at filtering on a CPU: an application's choice, for it to call
    before anything is computed. Importing `ewif_jax` changes no setting.

    * Loops over small arrays are compiled as one function each. Otherwise XLA calls one function
      for every operation, which takes longer than the operation where a single series or up to a
      few hundred runs are filtered: such filters become up to 20 times faster. (This is an option
      in the environment variable ``XLA_FLAGS``, unless that sets such options already.)
    * Every core is a device, over which batches spread their runs.
    * Memory that arrays of up to 1 GiB leave stays with the process (glibc): the system hands out
      new memory page by page, which takes up to half as long as filtering a large batch.
    * With `cache` programs are kept on disk: the next process reads what this one has compiled.
      What is kept is found again by the same program, versions of JAX and kind of processor alone.
      Several processes may share the folder; a file that is not whole costs a warning of JAX and a
      compilation. Nothing is ever deleted: the folder may be, at any time.

    Args:
        devices: how many devices (default: one for each core).
        cache: True: JAX's cache of compiled programs in the user's cache folder
            (``~/.cache/ewif_jax``, ``$XDG_CACHE_HOME/ewif_jax``, ``~/Library/Caches/ewif_jax``,
            ``%LOCALAPPDATA%\\ewif_jax\Cache``); or a folder; False: as JAX is configured. A
            folder chosen before (``JAX_COMPILATION_CACHE_DIR``) stays.

    Raises:
        RuntimeError: JAX has computed something already.
        ValueError: `devices` is not a whole number >= 1.
        OSError: a `cache` folder given that cannot be written in.
    """
    keep_programs(cache)
    count = _core_count() if devices is None else checks.whole("devices", devices, 1)
    flags = os.environ.get("XLA_FLAGS", "")
    chosen = _OPTIONS in flags
    # What an application has set itself stays as it is.
    if chosen and jax.config.values.get("jax_num_cpu_devices") == count:
        return  # a notebook's first cell may run again
    jax.config.update("jax_num_cpu_devices", count)
    if not chosen:
        os.environ["XLA_FLAGS"] = f"{flags} {_OPTIONS}={_WHOLE_LOOPS}={WHOLE_LOOPS_BELOW}".strip()
    _keep_memory()


_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
"""Of mallopt, as malloc.h numbers them."""


def _keep_memory() -> None:
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, 1 << 30)
        mallopt(_TRIM_THRESHOLD, (1 << 31) - 1)
        mallopt(_TOP_PAD, 1 << 26)  # lest the heaps of threads shrink and grow


def loops_are_joined() -> bool:
    """Whether this process compiles loops over small arrays as one function."""
    return _WHOLE_LOOPS in os.environ.get("XLA_FLAGS", "")


def _core_count() -> int:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return cores or 1


def quick_jit(fn: Callable[..., Any], static_argnames: Any, options: Mapping[str, Any]) -> Any:
    """`jax.jit`, with those of these options that this XLA knows, on a CPU, where nothing is
    transformed (a program inside another cannot have its own)."""
    plain = jax.jit(fn, static_argnames=static_argnames)

    @cache  # the backend, and so what it knows, is there from the first call on
    def quick() -> Any:
        understood = {name: options[name] for name in options if name in _known_options()}
        return jax.jit(fn, static_argnames=static_argnames, compiler_options=understood)

    @wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        return (plain if transformed() or not _known_options() else quick())(*args, **kwargs)

    return call


def array(x: Numbers, dtype: DTypeLike = None) -> jax.Array:
    """`x` as an array of JAX. Of an array of NumPy `jnp.asarray` makes it with a program, compiled
    for every shape; this makes it with none."""
    if isinstance(x, np.ndarray):
        return jax.device_put(np.array(native(x), dtype))  # of a copy, which nobody else can change
    return jnp.asarray(x, dtype)


def one_program(fn: Callable[..., Any]) -> Callable[..., Any]:
    """`fn`, compiled as a whole where it is called by itself; JAX would compile each of its
    operations. Inside another program it is a part of that."""
    compiled = jax.jit(fn)

    @wraps(fn)
    def call(*args: Any) -> Any:
        return fn(*args) if transformed() else compiled(*args)

    return call


def transformed() -> bool:
    """Whether what is called here becomes a part of another program."""
    # The state outside of any transformation is taken once, when the module loads, and under
    # compile-time evaluation: the import itself may happen inside of somebody's trace.
    return get_opaque_trace_state() != _OUTSIDE


with jax.ensure_compile_time_eval():
    _OUTSIDE = get_opaque_trace_state()


@cache
def _known_options() -> frozenset[str]:
    """The names of the options that this XLA knows: later ones have dropped some."""
    options = {**QUICKEST, **WIDE} if jax.default_backend() == "cpu" else {}
    # XLA refuses unknown options by name and one at a time, and has no list to ask: so a trivial
    # program is compiled with fewer and fewer of them.
    while options:
        try:
            jax.jit(lambda: 0, compiler_options=options)()
            break
        except JaxRuntimeError as error:  # which names the first that it does not know
            left = {name: value for name, value in options.items() if name not in str(error)}
            options = left if len(left) < len(options) else {}
    return frozenset(options)
