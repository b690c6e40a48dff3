"""Strict numerics for every test: float64 by default, no silent rank promotion; and a few, always
the same, random examples for every law. Programs are compiled quickly rather than made fast, but
with `--all` as for a user."""

import gc
import itertools
import os
import platform
import subprocess
import sys
from pathlib import Path

import jax
import jaxlib.version
import pytest
from hypothesis import Phase, settings

sys.path.insert(0, str(Path(__file__).parent))
from apart import FLAGS_OF_THE_TESTS

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

settings.register_profile(
    "few",
    max_examples=6,
    deadline=None,
    derandomize=True,
    database=None,
    phases=(Phase.explicit, Phase.generate),
)
settings.load_profile("few")

gc.freeze()
gc.set_threshold(50_000, 20, 100)  # tracing keeps most of what it makes

QUICK_TO_COMPILE = (
    "--xla_cpu_use_fusion_emitters=false",
    # A loop is one function, not one for each operation in it.
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1500000",
)
if platform.machine() in ("x86_64", "AMD64"):
    QUICK_TO_COMPILE += (
        "--xla_backend_optimization_level=0",
        "--xla_cpu_parallel_codegen_split_count=1",
        # Unoptimised code fuses some multiplications with additions and not others. With none,
        # programs that share random numbers round them equally.
        "--xla_cpu_max_isa=AVX",
    )
"""About a quarter of the time that XLA takes by default, for programs that mostly run once."""

LONGEST = (
    "test_tuning",
    "test_notebooks",
    "test_float32",
    "test_pcrlb",
    "test_late_studies",
    "test_two_bearings",
    "test_prepare_cpu",
    "test_track",
)
MAPS = Path("/proc/self/maps")
_tests = itertools.count(1)


@pytest.fixture(autouse=True)
def _room_for_compiled_programs():
    """Every compiled program takes memory maps, of which a Linux process may have 65,530 by
    default; beyond, the compiler crashes."""
    yield
    if next(_tests) % 4 == 0 and MAPS.exists() and MAPS.read_bytes().count(b"\n") > 40_000:
        jax.clear_caches()
        gc.collect()


def pytest_addoption(parser):
    parser.addoption("--all", action="store_true", help="also the slow tests")


def pytest_configure(config):
    if not config.getoption("--all") and FLAGS_OF_THE_TESTS not in os.environ:
        # Compiling takes most of the time. The workers of xdist inherit the flags.
        added = "".join(f" {flag}" for flag in known_flags(QUICK_TO_COMPILE))
        os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + added
        os.environ[FLAGS_OF_THE_TESTS] = added
    what = "slow: of full size, or covered by faster tests too; run with --all"
    config.addinivalue_line("markers", what)


def known_flags(flags):
    """Those that this XLA knows: it stops a process that gives it others, and names them."""
    if jaxlib.version.__version_info__ < (0, 11):
        return flags
    given = {**os.environ, "XLA_FLAGS": " ".join(flags), "JAX_PLATFORMS": "cpu"}
    look = [sys.executable, "-c", "import jax; jax.devices()"]
    done = subprocess.run(look, env=given, capture_output=True, text=True)
    return flags if done.returncode == 0 else [x for x in flags if x not in done.stderr]


@pytest.hookimpl(tryfirst=True)  # before xdist reads the groups
def pytest_collection_modifyitems(config, items):
    """Leaves out what is slow, unless `--all`. With `--dist loadgroup`, tests that share what they
    compile run in one process: those of a file, or in tests/contracts those of an estimator. The
    longest groups of the last files come first, lest one process waits for the other at the end."""
    if not config.getoption("--all"):
        left_out = [item for item in items if _slow(item)]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not _slow(item)]
    items.sort(key=lambda item: Path(item.fspath).stem not in LONGEST)
    for item in items:
        row = getattr(item, "callspec", None) and item.callspec.params.get("row")
        if config.pluginmanager.hasplugin("xdist"):
            name = Path(item.fspath).stem if row is None else row.name
            item.add_marker(pytest.mark.xdist_group(name))


def _slow(item):
    row = getattr(item, "callspec", None) and item.callspec.params.get("row")
    return item.get_closest_marker("slow") is not None or getattr(row, "variant", False)
