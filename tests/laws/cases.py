"""Random linear worlds for the laws: one compiled model per size, its matrices in `params`.

The dynamics are x' = G x + u + white noise with G = V diag(rates) V^-1, discretised exactly, so
they compose over any interval and reverse. The same matrices serve the NumPy oracles.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import ewif_jax as ej
from ewif_jax import Gaussian, Measurement

STEPS = 10
SENSORS = 2
COMPONENTS = 2


def _motion(xp: Any, p: Any, dt: Any) -> Any:
    return (p["V"] * xp.exp(p["rates"] * dt)[None, :]) @ p["U"]


def _input(xp: Any, p: Any, dt: Any) -> Any:
    return p["V"] @ (xp.expm1(p["rates"] * dt) / p["rates"] * (p["U"] @ p["u"]))


def _noise(xp: Any, p: Any, dt: Any) -> Any:
    pairs = p["rates"][:, None] + p["rates"][None, :]
    return p["V"] @ (p["q"] * xp.expm1(pairs * dt) / pairs) @ p["V"].T


@cache
def model() -> ej.Model:
    """The world as a `Model`; `params` holds every matrix."""
    return ej.linear_model(
        F=lambda p, t0, t1: _motion(jnp, p, t1 - t0),
        H=lambda p, sensor, t: p["H"][sensor],
        R=lambda p, sensor, t: p["R"][sensor],
        Q=lambda p, t0, t1: _noise(jnp, p, t1 - t0),
        b=lambda p, t0, t1: _input(jnp, p, t1 - t0),
    )


class Case(NamedTuple):
    """A random world with a prior and a stream in time order; `world` is what oracles ask for."""

    params: dict[str, Any]
    prior: Gaussian
    times: np.ndarray
    values: np.ndarray
    sensors: np.ndarray
    masks: np.ndarray

    def F(self, t0: float, t1: float) -> np.ndarray:
        return _motion(np, self.params, t1 - t0)

    def Q(self, t0: float, t1: float) -> np.ndarray:
        return _noise(np, self.params, t1 - t0)

    def b(self, t0: float, t1: float) -> np.ndarray:
        """x(t1) - F x(t0) without noise, in either direction."""
        return _input(np, self.params, t1 - t0)

    def stream(self, order: Any = None) -> Measurement:
        """The measurements in the given order of arrival."""
        k = np.arange(STEPS) if order is None else np.asarray(order)
        return Measurement(
            jnp.asarray(self.times[k]),
            jnp.asarray(self.values[k]),
            jnp.asarray(self.sensors[k], jnp.int32),
            jnp.asarray(self.masks[k]),
        )

    def data(self, kept: Any = None) -> dict[str, Any]:
        """times, H, R, values, masks of the measurements in `kept`, as the oracles take them."""
        k = np.arange(STEPS) if kept is None else np.asarray(kept)
        return {
            "times": self.times[k],
            "H": list(self.params["H"][self.sensors[k]]),
            "R": list(self.params["R"][self.sensors[k]]),
            "values": list(self.values[k]),
            "masks": self.masks[k],
        }

    def gaussian(self) -> dict[str, Any]:
        """The prior and the dynamics, as the Gaussian oracles take them."""
        return {
            "t0": 0.0,
            "prior_mean": self.prior.mean,
            "prior_cov": self.prior.cov,
            "F": self.F,
            "Q": self.Q,
            "b": self.b,
        }

    def back(self) -> dict[str, Callable[..., np.ndarray]]:
        """A(t_l, t) and its offset, as the least-squares oracle takes them."""
        return {"A": lambda t_l, t: self.F(t, t_l), "offset": lambda t_l, t: self.b(t, t_l)}


def spd(rng: np.random.Generator, n: int, floor: float = 0.3) -> np.ndarray:
    root = rng.normal(size=(n, n))
    return root @ root.T / n + floor * np.eye(n)


def case(seed: int, n: int, noise_rank: int | None = None) -> Case:
    """A world with n states; process noise of rank `noise_rank` (default n, 0: none)."""
    rng = np.random.default_rng(seed)
    V = np.linalg.qr(rng.normal(size=(n, n)))[0] * rng.uniform(0.7, 1.4, n)
    root = rng.normal(size=(n, n if noise_rank is None else noise_rank))
    params = {
        "V": V,
        "U": np.linalg.inv(V),
        "rates": rng.choice([-1.0, 1.0], n) * rng.uniform(0.05, 0.4, n),
        "q": 0.3 * root @ root.T,
        "u": rng.normal(size=n),
        "H": rng.normal(size=(SENSORS, COMPONENTS, n)),
        "R": np.stack([spd(rng, COMPONENTS) for _ in range(SENSORS)]),
        "tau": rng.uniform(0.7, 2.5),
    }
    times = np.sort(np.round(rng.uniform(0.1, 4.0, STEPS), 2))
    times[4] = times[3]
    masks = rng.uniform(size=(STEPS, COMPONENTS)) > 0.25
    masks[:n], masks[6] = True, False
    prior = Gaussian(rng.normal(size=n), spd(rng, n))
    values = 2.0 * rng.normal(size=(STEPS, COMPONENTS))
    return Case(params, prior, times, values, rng.integers(0, SENSORS, STEPS), masks)


def close(actual: Any, expected: Any, rtol: float = 1e-9) -> None:
    """`actual` equals `expected` to `rtol` of its largest number."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape
    scale = np.abs(expected).max(initial=1e-30)
    np.testing.assert_allclose(actual / scale, expected / scale, rtol=0.0, atol=rtol)
