"""Random linear models with two sensors, and irregular streams that arrive out of order."""

import itertools
import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from oracles.joint_gaussian import posterior

import ewif_jax as ej


class Problem(NamedTuple):
    """The same model for us (`model`, `prior`) and the oracles (`oracle`); H and R by sensor."""

    model: ej.Model
    prior: ej.Gaussian
    oracle: dict
    H: np.ndarray
    R: np.ndarray


def polynomials(A, D, push):
    """Coefficients in dt of F, Q and b for dx = A x dt + push dt + noise of density D, A nilpotent.

    They are the exact integrals, so they compose over sub-intervals.
    """
    n = len(A)
    powers = [np.linalg.matrix_power(A, k) / math.factorial(k) for k in range(n)]
    Q = np.zeros((2 * n, n, n))
    for j, k in itertools.product(range(n), range(n)):
        Q[j + k + 1] += powers[j] @ D @ powers[k].T / (j + k + 1)
    b = np.zeros((n + 1, n))
    for k in range(n):
        b[k + 1] = powers[k] @ push / (k + 1)
    return np.array(powers), Q, b


def polynomial(terms, dt):
    """terms[0] + terms[1] dt + ..., for a number or a traced dt."""
    total = terms[-1]
    for term in terms[-2::-1]:
        total = total * dt + term
    return total


def problem(seed: int, n: int, m: int = 1, noise_rank: int | None = None) -> Problem:
    rng = np.random.default_rng(seed)
    basis = scipy.linalg.orth(rng.normal(size=(n, n)))
    A = basis @ np.triu(rng.normal(size=(n, n)), 1) @ basis.T
    root = rng.normal(size=(n, n if noise_rank is None else noise_rank))
    return observed(rng, A, 0.3 * root @ root.T, m)


def chain(seed: int, n: int, affine: bool) -> Problem:
    """n integrators in a row, the last one driven by noise, in orthogonal or affine axes."""
    rng = np.random.default_rng(seed)
    mix = rng.normal(size=(n, n))
    mix = mix + 2 * np.eye(n) if affine else scipy.linalg.orth(mix)
    A = mix @ np.eye(n, k=1) @ np.linalg.inv(mix)
    return observed(rng, A, 0.3 * np.outer(mix[:, -1], mix[:, -1]), 1)


def observed(rng: np.random.Generator, A: np.ndarray, D: np.ndarray, m: int) -> Problem:
    """Random input, sensors and prior for the motion dx = A x dt + noise of density D."""
    n = len(A)
    push = rng.normal(size=n)
    H = rng.normal(size=(2, m, n))
    L = rng.normal(size=(2, m, m))
    R = 0.2 * L @ L.transpose(0, 2, 1) + 0.1 * np.eye(m)
    P = rng.normal(size=(n, n))
    mean, cov = rng.normal(size=n), P @ P.T + 0.1 * np.eye(n)

    F, Q, b = polynomials(A, D, push)
    model = ej.linear_model(
        F=lambda p, t0, t1: polynomial(F, t1 - t0),
        Q=lambda p, t0, t1: polynomial(Q, t1 - t0),
        H=H,
        R=R,
        b=lambda p, t0, t1: polynomial(b, t1 - t0),
    )
    oracle = {
        "t0": 0.0,
        "prior_mean": mean,
        "prior_cov": cov,
        "F": lambda t0, t1: polynomial(F, t1 - t0),
        "Q": lambda t0, t1: polynomial(Q, t1 - t0),
        "b": lambda t0, t1: polynomial(b, t1 - t0),
    }
    return Problem(model, ej.Gaussian(jnp.asarray(mean), jnp.asarray(cov)), oracle, H, R)


def stream(problem: Problem, rng: np.random.Generator, times) -> ej.Measurement:
    """Random values at `times` (in order of arrival) from random sensors."""
    count, m = len(times), problem.H.shape[1]
    return ej.stream(times, rng.normal(size=(count, m)), rng.integers(0, 2, count))


def exact(problem: Problem, data: ej.Measurement) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance at the newest time, given everything that has arrived, per arrival."""
    times, sensors = np.asarray(data.time), np.asarray(data.sensor)
    found = [
        posterior(
            times[: k + 1].max(),
            **problem.oracle,
            times=times[: k + 1],
            H=problem.H[sensors[: k + 1]],
            R=problem.R[sensors[: k + 1]],
            values=np.asarray(data.value)[: k + 1],
        )
        for k in range(len(times))
    ]
    means, covs = zip(*found, strict=True)
    return np.array(means), np.array(covs)
