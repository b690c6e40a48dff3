"""The filter that `ewif-jax track` runs: model, estimator, parameters and a start that knows
nothing."""

import argparse
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ewif_jax import models
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.fading import fading
from ewif_jax.estimators.gated import gated
from ewif_jax.estimators.information import information
from ewif_jax.estimators.kalman import kalman
from ewif_jax.estimators.robust import robust
from ewif_jax.estimators.square_root import square_root
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.asd import asd
from ewif_jax.study.shared.refusal import Refused
from ewif_jax.study.track.tracks import Tracks
from ewif_jax.transforms import Transform, positive
from ewif_jax.types import Estimator, Gaussian

MODELS = {
    "random-walk": models.random_walk,
    "constant-velocity": models.constant_velocity,
    "constant-acceleration": models.constant_acceleration,
}
BUILDERS = {
    "ewif": lambda model, lag: ewif(model, tau=lambda p: p["tau"]),
    "kalman": lambda model, lag: kalman(model),
    "information": lambda model, lag: information(model),
    "square-root": lambda model, lag: square_root(model),
    "fading": lambda model, lag: fading(model, lambda p: p["fading"]),
    "al1": al1,
    "asd": asd,
}
UNKNOWN = 1e3
"""Standard deviations at the start, in units of what one interval of measurements tells."""


MOST_LAG = 1000
"""a history that is always allowed; a longer one has to have measurements to hold"""


class TrackMethod(NamedTuple):
    """estimator and params; name, unit and transform of the parameter that can be tuned; prior:
    of all tracks (means (R, n), one covariance)."""

    estimator: Estimator
    params: dict[str, Any]
    name: str
    unit: str
    transform: Transform
    prior: Gaussian | None

    def prior_of(self, tracks: np.ndarray) -> Gaussian | None:
        """The prior of some of the tracks."""
        return None if self.prior is None else Gaussian(self.prior.mean[tracks], self.prior.cov)


def track_method(arguments: argparse.Namespace, tracks: Tracks) -> TrackMethod:
    """The filter that the arguments ask for.

    What is not given follows from the noise s and the median interval dt of the measurements:
    tau = 5 dt, and q such that the model's noise over one interval is about as large as s.
    """
    order = list(MODELS).index(arguments.model)
    dims = tracks.value.shape[-1]
    longest = int(np.bincount(tracks.row).max())
    if arguments.lag > max(longest, MOST_LAG):
        raise Refused(
            f"--lag: expected at most {max(longest, MOST_LAG)}, as the longest track has {longest} "
            f"measurements, got {arguments.lag}"
        )
    noise, interval = _noise_of(arguments.noise, tracks.sensors), _median_interval(tracks)
    sensors = [models.position_sensor(s**2, dims) for s in noise]
    model = MODELS[arguments.model](sensors=sensors, q=lambda p: p["q"], dims=dims)
    estimator = BUILDERS[arguments.estimator](model, arguments.lag)
    if arguments.robust is not None:
        estimator = robust(estimator, arguments.robust)
    if arguments.gate is not None:
        estimator = gated(estimator, arguments.gate)
    prior = None
    if arguments.estimator not in ("ewif", "information"):
        spread = UNKNOWN * max(noise) / interval ** np.arange(order + 1)
        mean = np.zeros((len(tracks.name), (order + 1) * dims))
        first = tracks.rank() == 0
        mean[:, :dims] = np.where(tracks.mask, tracks.value, 0)[first]
        prior = Gaussian(jnp.asarray(mean), jnp.diag(jnp.repeat(jnp.asarray(spread**2), dims)))
    q = arguments.q or max(noise) ** 2 / interval ** (2 * order + 1)
    if arguments.estimator == "ewif":
        name, unit, value, transform = "tau", "s", arguments.tau or 5 * interval, positive()
    elif arguments.estimator == "fading":
        name, unit, value, transform = "fading", "1", arguments.fading or 1.2, _above_one()
        q = arguments.q or 0.0
    else:
        name, unit, value, transform = "q", f"m^2/s^{2 * order + 1}", q, positive()
    params = {"q": q, name: value}
    used = params if arguments.estimator != "ewif" else {name: value}
    params = {key: jnp.asarray(np.asarray(x, float)) for key, x in used.items()}
    return TrackMethod(estimator, params, name, unit, transform, prior)


def _noise_of(given: dict[str, float], sensors: list[str]) -> list[float]:
    if "" in given:
        return [given[""]] * len(sensors)
    missing = [name for name in sensors if name not in given]
    if missing:
        raise Refused(f"--noise: says nothing of sensor {', '.join(map(repr, missing))}")
    return [given[name] for name in sensors]


def _median_interval(tracks: Tracks) -> float:
    """The median time between measurements of a track, in seconds."""
    order = np.lexsort((tracks.time, tracks.row))
    steps = np.diff(tracks.time[order])[np.diff(tracks.row) == 0]
    steps = steps[steps > 0]
    return float(np.median(steps)) if steps.size else 1.0


def _above_one() -> Transform:
    return Transform(lambda raw: 1 + jnp.exp(raw), lambda value: jnp.log(value - 1))
