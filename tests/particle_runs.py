"""Many runs of a particle filter on one stream, and how far their average is from a claim."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import ewif_jax as ej


def runs(
    estimator: ej.Estimator,
    data: ej.Measurement,
    prior: ej.Gaussian,
    keys: int,
    params: Any = None,
    of: Callable[[ej.Trace], Any] = lambda trace: (trace.mean, trace.cov),
) -> Any:
    """`of` the trace of each of `keys` runs, stacked as NumPy arrays; one after the other, as a
    branch that is not taken then costs nothing."""

    def one(key: jax.Array) -> Any:
        return of(ej.run(estimator, params, data, prior=prior, t0=0.0, key=key))

    found = jax.jit(lambda keys: jax.lax.map(one, keys))(jax.random.split(jax.random.key(5), keys))
    return jax.tree.map(np.asarray, found)


def deviation(samples: np.ndarray, claim: np.ndarray) -> float:
    """The largest |mean of samples - claim| in standard errors of the mean."""
    error = samples.std(0, ddof=1) / np.sqrt(len(samples))
    return float(np.max(np.abs(samples.mean(0) - claim) / error))
