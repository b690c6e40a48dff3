"""Strict numerics for every test: float64 by default, no silent rank promotion; and a few, always
the same, random examples for every law."""

import sys
from pathlib import Path

import jax
import pytest
from hypothesis import Phase, settings

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
sys.path.insert(0, str(Path(__file__).parent))

settings.register_profile(
    "few",
    max_examples=6,
    deadline=None,
    derandomize=True,
    database=None,
    phases=(Phase.explicit, Phase.generate),
)
settings.load_profile("few")


def pytest_collection_modifyitems(items):
    """With `--dist loadgroup`, tests that share what they compile run in one process: those of a
    file, or in tests/contracts those of an estimator. Studies share nothing."""
    for item in items:
        room = Path(item.fspath).parent.name
        row = getattr(item, "callspec", None) and item.callspec.params.get("row")
        if room != "study":
            name = f"{room}-{row.name}" if row is not None else str(item.fspath)
            item.add_marker(pytest.mark.xdist_group(name))
