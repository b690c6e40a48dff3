"""Random models and streams for the attack, and what a NumPy Kalman filter makes of them.

One model serves all values of a shape: everything that is drawn travels in `params`, so that each
estimator is compiled once for each shape.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import ewif_jax as ej


def motion(xp: Any, p: Any, dt: Any) -> Any:
    """F (n, n): real modes `rate` in the axes `basis`; a mode that is `dead` forgets at once."""
    decay = xp.where(p["dead"] & (dt != 0), 0.0, xp.exp(p["rate"] * dt))
    return (p["basis"] * decay[None, :]) @ p["inverse"]


def integral(xp: Any, rate: Any, dt: Any) -> Any:
    """The integral of exp(rate s) over s from 0 to dt."""
    still = rate == 0
    safe = xp.where(still, 1.0, rate)
    return xp.where(still, dt, xp.expm1(safe * dt) / safe)


def noise(xp: Any, p: Any, dt: Any) -> Any:
    dead = p["dead"]
    grown = integral(xp, p["rate"][:, None] + p["rate"][None, :], dt)
    both, either = dead[:, None] & dead[None, :], dead[:, None] | dead[None, :]
    moved = xp.where(dt > 0, 1.0, 0.0)
    modal = p["density"] * xp.where(both, moved, xp.where(either, 0.0, grown))
    return p["basis"] @ modal @ p["basis"].T


def push(xp: Any, p: Any, dt: Any) -> Any:
    moved = xp.where(dt > 0, 1.0, 0.0)
    return p["basis"] @ (p["push"] * xp.where(p["dead"], moved, integral(xp, p["rate"], dt)))


def linear_world() -> ej.Model:
    return ej.linear_model(
        lambda p, t0, t1: motion(jnp, p, t1 - t0),
        lambda p, sensor, t: p["H"][sensor],
        lambda p, sensor, t: p["R"][sensor],
        lambda p, t0, t1: noise(jnp, p, t1 - t0),
        lambda p, t0, t1: push(jnp, p, t1 - t0),
    )


def bend(xp: Any, seen: Any) -> Any:
    return seen + 0.8 * xp.sin(seen)


def bent_world() -> ej.Model:
    """The same motion, seen by sensors that bend what they see."""

    def observe(p: Any, x: Any, sensor: Any, t: Any) -> Any:
        return bend(jnp, p["H"][sensor] @ x)

    linear = linear_world()
    return ej.Model(
        linear.transition, linear.process_cov, observe, lambda p, sensor, t: p["R"][sensor]
    )


class Problem(NamedTuple):
    """What is drawn for one seed: `traits` are the choices, by name."""

    params: dict[str, Any]
    stream: ej.Measurement
    prior: ej.Gaussian
    traits: dict[str, str]


def _covariance(rng: np.random.Generator, n: int, kind: str, low: float, high: float) -> Any:
    """(n, n) of a size drawn between 10^low and 10^high."""
    root = rng.normal(size=(n, n))
    if kind == "singular":
        root[:, max(n - 1, 1) // 2 + (n == 1) :] = 0
    cov = root @ root.T + (0.05 * np.eye(n) if kind == "full" else 0)
    if kind == "exact part":
        cov[0] = cov[:, 0] = 0
    return cov * (0.0 if kind == "zero" else 10 ** rng.uniform(low, high))


RATES = {
    "stable": (-1.0, -0.05), "unstable": (-0.3, 0.8), "fast": (-12.0, -0.5), "still": (0.0, 0.0),
}  # fmt: skip


def problem(seed: int, n: int, m: int, sensors: int, steps: int, dtype: Any) -> Problem:
    """The problem of a seed; t0 is 0."""
    rng = np.random.default_rng([seed, n, m, sensors])
    draw = lambda options, p: str(rng.choice(options, p=p))  # noqa: E731
    traits = {
        "rates": draw(list(RATES), [0.4, 0.3, 0.15, 0.15]),
        "dead": draw(["none", "some"], [0.85, 0.15]),
        "Q": draw(["full", "singular", "zero"], [0.6, 0.2, 0.2]),
        "R": draw(["full", "singular", "zero", "exact part"], [0.7, 0.1, 0.1, 0.1]),
        "P": draw(["full", "singular", "zero"], [0.7, 0.15, 0.15]),
        "times": draw(["regular", "irregular", "gaps", "duplicates"], [0.2, 0.4, 0.2, 0.2]),
        "late": draw(["none", "one", "many"], [0.5, 0.25, 0.25]),
        "masks": draw(["none", "rows", "components"], [0.4, 0.3, 0.3]),
        "values": draw(["model", "far", "huge"], [0.85, 0.1, 0.05]),
    }
    rate = rng.uniform(*RATES[traits["rates"]], n)
    basis = np.linalg.qr(rng.normal(size=(n, n)))[0] * rng.uniform(0.5, 2, n)
    dead = (rng.random(n) < 0.5) & (traits["dead"] == "some")
    params = {
        "basis": basis,
        "inverse": np.linalg.inv(basis),
        "rate": rate,
        "dead": dead,
        "density": _covariance(rng, n, traits["Q"], -3, 1),
        "push": rng.normal(size=n) * (rng.random() < 0.5),
        "H": rng.normal(size=(sensors, m, n)) * (rng.random((sensors, m, n)) < 0.8),
        "R": np.array([_covariance(rng, m, traits["R"], -3, 1) for _ in range(sensors)]),
        "tau": rng.uniform(0.5, 5),
        "window": rng.uniform(0.5, 5),
        "fading": rng.uniform(1, 1.2),
        "max_delay": rng.uniform(0.1, 2),
        "probability": 0.999,
        "c": 3.0,
    }
    prior = ej.Gaussian(rng.normal(size=n), _covariance(rng, n, traits["P"], -2, 2))
    gap = rng.uniform(0.05, 1.0, steps) if traits["times"] != "regular" else np.full(steps, 0.5)
    if traits["times"] == "gaps":
        gap[rng.integers(1, steps, 2)] *= 30
    if traits["times"] == "duplicates":
        gap[rng.random(steps) < 0.4] = 0
    time = np.cumsum(gap) + 0.25
    late = {"none": 0, "one": 1, "many": steps // 4}[traits["late"]]
    for k in rng.choice(np.arange(2, steps), late, replace=False):
        time[k] = max(time[k] - rng.uniform(0.1, 3) * gap.mean(), 0.125)
    sensor = rng.integers(0, sensors, steps).astype(np.int32)
    mask = np.ones((steps, m), bool)
    if traits["masks"] == "rows":
        mask[rng.random(steps) < 0.3] = False
    elif traits["masks"] == "components":
        mask &= rng.random((steps, m)) < 0.7
    value = _values(rng, params, prior, time, sensor, traits["values"])
    stream = ej.Measurement(
        time.astype(dtype), np.where(mask, value, 0).astype(dtype), sensor, mask
    )
    cast = {k: np.asarray(v) if k == "dead" else np.asarray(v, dtype) for k, v in params.items()}
    prior = ej.Gaussian(*(np.asarray(x, dtype) for x in prior))
    return Problem(cast, stream, prior, traits)


def _values(rng: Any, p: Any, prior: Any, time: Any, sensor: Any, kind: str) -> Any:
    """What the sensors see of one path drawn from the model."""
    order, x, now = np.argsort(time, kind="stable"), None, 0.0
    value = np.zeros((len(time), p["R"].shape[1]))
    x = rng.multivariate_normal(prior.mean, prior.cov, method="svd")
    for k in order:
        dt = time[k] - now
        cov = noise(np, p, dt)
        x = motion(np, p, dt) @ x + push(np, p, dt)
        x = x + rng.multivariate_normal(np.zeros(len(x)), cov, method="svd")
        error = rng.multivariate_normal(np.zeros(value.shape[1]), p["R"][sensor[k]], method="svd")
        value[k], now = p["H"][sensor[k]] @ x + error, time[k]
    if kind == "far":
        value[rng.integers(len(time))] += 1e3
    if kind == "huge":
        value[rng.integers(len(time))] = 10 ** rng.uniform(10, 25)
    return value


class Expected(NamedTuple):
    """mean, cov; whether an innovation covariance was singular; the log density of the last row."""

    mean: np.ndarray
    cov: np.ndarray
    singular: bool
    log_density: float


def filtered(
    given: Problem,
    rows: Any,
    until: float,
    inflate: Any = None,
    noisy: bool = True,
    blur: Any = None,
) -> Expected:
    """The Kalman estimate at `until` from these rows, in the order of their times.

    `inflate(dt)` multiplies the moved covariance. With `blur`, (generator, eps), every matrix is
    off by a relative eps at every step: how far that moves the answer tells what rounding may do.
    """
    p = {k: np.asarray(v, float if k != "dead" else bool) for k, v in given.params.items()}
    x, P = (np.asarray(v, float) for v in given.prior)
    times = np.asarray(given.stream.time, float)
    now, density = 0.0, 0.0

    def off(a: Any) -> Any:
        return a if blur is None else a * (1 + blur[1] * blur[0].uniform(-1, 1, np.shape(a)))

    for k in [*sorted(rows, key=lambda row: times[row]), None]:
        time = until if k is None else times[k]
        dt = time - now
        F = off(motion(np, p, dt))
        P = F @ P @ F.T * (1.0 if inflate is None else inflate(dt))
        P = off(P + noise(np, p, dt) if noisy else P)
        P, x, now = (P + P.T) / 2, off(F @ x + push(np, p, dt)), time
        if k is None:
            break
        seen, s = given.stream.mask[k], given.stream.sensor[k]
        H, R = off(p["H"][s][seen]), p["R"][s][np.ix_(seen, seen)]
        S = H @ P @ H.T + R
        size = np.sqrt(np.maximum(np.diag(S), 1e-300))
        if np.linalg.eigvalsh(S / np.outer(size, size)).min() < 1e-9 or size.min() < 1e-12:
            return Expected(x, P, True, density)
        K = np.linalg.solve(S, H @ P).T
        nu = np.asarray(given.stream.value, float)[k][seen] - H @ x
        density = -(nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1]) / 2
        x = off(x + K @ nu)
        left = np.eye(len(x)) - K @ H
        P = left @ P @ left.T + K @ R @ K.T
    return Expected(x, P, False, density)
