"""The sine of Shulami & Sigalov, section V-C."""

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.models import Model, linear_model
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Measurement


@from_recipe
def sine_model(r: float = 0.5) -> Model:
    """A scalar that stands still, with process noise params["sigma_w"] per sample and measurement
    variance `r`: the wrong model by which the paper tracks the sine."""

    def Q(params: dict, t0: Array, t1: Array) -> Array:
        return jnp.where(t0 == t1, 0.0, 1.0) * jnp.square(params["sigma_w"]) * jnp.ones((1, 1))

    return linear_model(
        F=lambda params, t0, t1: jnp.eye(1), H=jnp.eye(1), R=jnp.asarray([[r]]), Q=Q
    )


def sine_signal(
    amplitude: float = 1.0, frequency: float = 0.1, dt: float = 0.1, length: float = 10.0
) -> tuple[Array, Array]:
    """Times (T,) from 0 to `length` s every `dt` s, and amplitude sin(2 pi frequency t) (T, 1)."""
    checks.positive("dt", dt)
    checks.positive("length", length)
    time = jnp.arange(round(length / dt) + 1) * dt
    return time, amplitude * jnp.sin(2 * jnp.pi * frequency * time)[:, None]


@from_recipe
def sine(
    amplitude: float = 1.0,
    frequency: float = 0.1,
    dt: float = 0.1,
    length: float = 10.0,
    r: float = 0.5,
) -> Scenario:
    """A sine (amplitude, frequency in Hz) seen every `dt` s for `length` s with noise variance `r`;
    nothing is known at the start.

    The paper prints the variance 0.5 only; the other defaults reproduce its two RMS errors.
    """
    checks.positive("r", r)
    time, truth = sine_signal(amplitude, frequency, dt, length)
    steps = time.shape[0]

    def simulate(key: Array) -> Simulation:
        noise = jnp.sqrt(r) * jax.random.normal(key, truth.shape, truth.dtype)
        stream = Measurement(
            time, truth + noise, jnp.zeros(steps, jnp.int32), jnp.ones((steps, 1), bool)
        )
        return Simulation(stream, truth)

    return Scenario(simulate, None, 0.0)
