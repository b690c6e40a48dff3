"""The streams: fixed by their name and a seed, in plain NumPy.

A target in the plane, [x, y, vx, vy], moves with nearly constant velocity and is seen every second.
What a method may know of the world is in `World`; what was drawn is in `Stream`.
"""

import zlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

LAG = 12
"""How many measurements, or past times, a method keeps: more than the longest delay."""


class World(NamedTuple):
    """What a method is told. mean (4,), cov (4, 4): the state at time 0. q: process noise, m^2/s^3.
    r: variance of each coordinate seen, m^2 (of a polar sensor that of the range); bearing: rad^2.
    jitter: standard deviation of stamps, s. modes: the q of a target that manoeuvres, which it
    leaves with probability `leaves` each second; q is then their mean."""

    mean: np.ndarray
    cov: np.ndarray
    q: float
    r: float
    bearing: float = 0.0
    jitter: float = 0.0
    modes: tuple[float, ...] = ()
    leaves: float = 0.0
    outlier: float = 0.0
    """variance of an outlier beside r, of which only the exact answer knows which they are"""

    @property
    def is_linear(self) -> bool:
        """Whether H below is what the sensor sees."""
        return self.bearing == 0

    @property
    def H(self) -> np.ndarray:
        """(2, 4), of a linear world."""
        return np.eye(2, 4)

    @property
    def R(self) -> np.ndarray:
        """(2, 2)."""
        return np.diag([self.r, self.r if self.is_linear else self.bearing])

    def F(self, dt: float) -> np.ndarray:
        """(4, 4) over dt seconds."""
        return np.eye(4) + dt * np.eye(4, k=2)

    def Q(self, dt: float) -> np.ndarray:
        """(4, 4) gathered over dt seconds."""
        axis = self.q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        return np.kron(axis, np.eye(2))


class Stream(NamedTuple):
    """R runs of T rows in order of arrival. time (R, T): stamps. now (R, T): when each arrives.
    value (R, T, 2). there (R, T): False for what is lost. label (R, T): 1 for an outlier. newest
    (R, T): the newest stamp so far, for which an estimate is asked; truth (R, T, 4) then, NaN where
    nobody knows it."""

    name: str
    about: str
    world: World
    time: np.ndarray
    now: np.ndarray
    value: np.ndarray
    there: np.ndarray
    label: np.ndarray
    newest: np.ndarray
    truth: np.ndarray


class Case(NamedTuple):
    """How a stream is drawn: delay(rng, size) in seconds of the share that is `late`."""

    about: str
    world: World
    late: float = 0.0
    delay: Callable[[np.random.Generator, tuple[int, int]], np.ndarray] | None = None
    lost: float = 0.0
    outliers: float = 0.0


def uniform(low: float, high: float) -> Callable[..., np.ndarray]:
    """Delays between two numbers of seconds."""
    return lambda rng, size: rng.uniform(low, high, size)


def exponential(mean: float, most: float) -> Callable[..., np.ndarray]:
    """Delays of a mean, cut at `most` seconds."""
    return lambda rng, size: np.minimum(rng.exponential(mean, size), most)


FLAT = World(np.zeros(4), np.diag([4.0, 4.0, 1.0, 1.0]), 0.1, 1.0)
FAST = FLAT._replace(cov=np.diag([4.0, 4.0, 25.0, 25.0]), jitter=0.2)
POLAR = World(
    np.array([-50.0, 25.0, 1.0, 0.0]), np.diag([9.0, 9.0, 0.25, 0.25]), 0.02, 1.0, bearing=0.03**2
)
TURNING = FLAT._replace(q=1.0, modes=(0.02, 2.0), leaves=0.05)

CASES = {
    "in sequence": Case("nothing is late", FLAT),
    "short delays": Case("half are late by up to 2 s", FLAT, 0.5, uniform(0.0, 2.0)),
    "heavy delays": Case(
        "70 % are late, exponentially by 4 s on average, at most 10 s", FLAT, 0.7,
        exponential(4.0, 10.0),
    ),
    "lost data": Case(
        "30 % never arrive, half of the rest are late by up to 4 s", FLAT, 0.5, uniform(0.0, 4.0),
        lost=0.3,
    ),
    "jittered stamps": Case(
        "stamps err by 0.2 s, the target is fast, half are late by up to 4 s", FAST, 0.5,
        uniform(0.0, 4.0),
    ),
    "outliers": Case(
        "5 % err by 20 m, half are late by up to 4 s", FLAT._replace(outlier=400.0), 0.5,
        uniform(0.0, 4.0), outliers=0.05,
    ),
    "range and bearing": Case(
        "a radar at the origin, 1 m and 0.03 rad, half are late by up to 4 s", POLAR, 0.5,
        uniform(0.0, 4.0),
    ),
    "manoeuvring": Case(
        "q is 0.02 or 2, changing every 20 s on average, half are late by up to 4 s", TURNING, 0.5,
        uniform(0.0, 4.0),
    ),
}  # fmt: skip


def drawn(name: str, runs: int, steps: int, seed: int) -> Stream:
    """The stream of that name: the same numbers for the same arguments, whoever asks."""
    case = CASES[name]
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    world, size = case.world, (runs, steps)
    true_time = np.broadcast_to(np.arange(1.0, steps + 1), size)
    stamp = true_time + world.jitter * np.clip(rng.normal(size=size), -2, 2)
    both = np.concatenate([true_time, stamp], 1)
    sorting = np.argsort(both, 1, kind="stable")
    path = np.empty((runs, 2 * steps, 4))
    moved = _path(world, np.take_along_axis(both, sorting, 1), rng)
    np.put_along_axis(path, sorting[:, :, None], moved, 1)
    at_time, at_stamp = path[:, :steps], path[:, steps:]
    label = (rng.random(size) < case.outliers).astype(np.int32)
    value = _seen(world, at_time, label, rng)
    there = rng.random(size) >= case.lost
    is_late = rng.random(size) < case.late
    delay = np.zeros(size) if case.delay is None else case.delay(rng, size) * is_late
    now = np.maximum(true_time, stamp) + delay
    order = np.argsort(now, 1, kind="stable")
    time, now, there, label = (np.take_along_axis(x, order, 1) for x in (stamp, now, there, label))
    value = np.take_along_axis(value, order[:, :, None], 1)
    newest, place = newest_of(time, there)
    known = np.take_along_axis(at_stamp, order[:, :, None], 1)
    truth = np.take_along_axis(known, place[:, :, None], 1)
    return Stream(name, case.about, world, time, now, value, there, label, newest, truth)


def newest_of(time: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest time (R, T) that has arrived so far, and its row; before any, the first."""
    stamps = np.where(there, time, -np.inf)
    largest = np.maximum.accumulate(stamps, 1)
    is_new = stamps == largest
    place = np.maximum.accumulate(np.where(is_new & there, np.arange(time.shape[1]), 0), 1)
    return np.take_along_axis(time, place, 1), place


def _path(world: World, times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The state (R, K, 4) at increasing times (R, K)."""
    runs, count = times.shape
    root = np.linalg.cholesky(world.cov)
    x = world.mean + rng.normal(size=(runs, 4)) @ root.T
    mode, before, path = np.zeros(runs, int), np.zeros(runs), []
    for k in range(count):
        dt = times[:, k] - before
        q = np.full(runs, world.q)
        if world.modes:
            change = rng.random(runs) < -np.expm1(dt * np.log1p(-world.leaves))
            mode = np.where(change, 1 - mode, mode)
            q = np.asarray(world.modes)[mode]
        first, second = rng.normal(size=(2, runs, 2))
        shift = np.sqrt(q * dt**3 / 3)[:, None] * first
        push = np.sqrt(q * dt)[:, None] * (np.sqrt(3) / 2 * first + second / 2)
        x = np.concatenate([x[:, :2] + dt[:, None] * x[:, 2:] + shift, x[:, 2:] + push], 1)
        before = times[:, k]
        path.append(x)
    return np.stack(path, 1)


def _seen(world: World, x: np.ndarray, label: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What the sensor says (R, T, 2) of states (R, T, 4)."""
    noise = rng.normal(size=(*label.shape, 2)) * np.sqrt(np.diag(world.R))
    noise += (np.sqrt(world.outlier) * rng.normal(size=noise.shape)) * label[:, :, None]
    if world.is_linear:
        return x[:, :, :2] + noise
    polar = np.stack([np.hypot(x[..., 0], x[..., 1]), np.arctan2(x[..., 1], x[..., 0])], -1)
    return polar + noise
