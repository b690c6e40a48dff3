"""A small world with parameters: a random walk, every second measurement late."""

import jax
import jax.numpy as jnp
import numpy as np

import ewif_jax as ej
from ewif_jax.scenarios.delays import deliver

STEPS = 12
PRIOR = ej.Gaussian(np.zeros(1), 4.0 * np.eye(1))
KEY = jax.random.key(3)
MODEL = ej.models.random_walk(sensors=ej.models.position_sensor(1.0), q=lambda p: p["q"])
STILL = ej.models.random_walk(sensors=ej.models.position_sensor(1.0), q=0.0)
EWIF = ej.ewif(STILL, tau=lambda p: p["tau"])
METRICS = {"position": ej.scores.squared_error}


def simulate(key, params):
    start, motion, noise = jnp.split(jax.random.normal(key, (2 * STEPS + 1,)), [1, STEPS + 1])
    time = jnp.arange(1.0, STEPS + 1)
    truth = (2 * start + jnp.cumsum(jnp.sqrt(params["q"]) * motion))[:, None]
    delay = jnp.where(jnp.arange(STEPS) % 2 == 1, params["delay"], 0.0)
    arrived = deliver(time, truth + noise[:, None], delay)
    return ej.Simulation(arrived.measurements, truth[jax.lax.cummax(arrived.order)])


WORLD = ej.Scenario(simulate, PRIOR, 0.0, params={"q": 0.5, "delay": 0.0})
OVER = {"delay": [0.0, 1.4, 2.6], "q": [0.1, 1.0]}


def methods():
    lab = ej.lab
    follows = {"q": lab.axis("q")}
    return {
        "drop": lab.Method(ej.drop_late(ej.kalman(MODEL)), follows),
        "Al1": lab.Method(ej.al1(MODEL, lag=6), follows),
        "EWIF": lab.Method(EWIF, {"tau": 2.0}, prior=None),
    }
