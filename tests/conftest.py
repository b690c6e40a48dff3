"""Strict numerics for every test: float64 by default, no silent rank promotion; and a few, always
the same, random examples for every law."""

import sys
from pathlib import Path

import jax
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
