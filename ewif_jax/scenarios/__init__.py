"""Worlds to test filters in."""

from ewif_jax.scenarios.sine import sine, sine_model, sine_signal

__all__ = ["sine", "sine_model", "sine_signal"]
