"""Methods of others. Each is built by a `World` and takes one arrival at a time:

``arrive(now, time, value)`` returns the mean (4,) and covariance (4, 4) at the newest time so far;
``numbers()`` says how many floating-point numbers it holds. Their libraries are in the extra
`bench`; a row whose library is missing says so.
"""

import heapq
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from functools import partial
from typing import Protocol

import numpy as np

from benchmarks.oosm.streams import LAG, World

START = datetime(2000, 1, 1)


class Stepwise(Protocol):
    """What a method of others is, and one of yours."""

    def arrive(
        self, now: float, time: float, value: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]: ...


Build = Callable[[World], Stepwise]


def filterpy_filter(world: World):
    """FilterPy's `KalmanFilter` of a linear world, at time 0."""
    from filterpy.kalman import KalmanFilter

    kf = KalmanFilter(dim_x=4, dim_z=2)
    kf.x, kf.P, kf.H, kf.R = world.mean.copy(), world.cov.copy(), world.H, world.R
    return kf


class FilterPyNaive:
    """FilterPy, with a late measurement taken for one of now."""

    def __init__(self, world: World):
        self.world, self.kf, self.time = world, filterpy_filter(world), 0.0

    def arrive(self, now, time, value):
        dt = max(time - self.time, 0.0)
        self.kf.predict(F=self.world.F(dt), Q=self.world.Q(dt))
        self.kf.update(value)
        self.time += dt
        return self.kf.x, self.kf.P

    def numbers(self) -> int:
        return self.kf.x.size + self.kf.P.size


class FilterPyBuffer:
    """FilterPy behind a buffer that releases in order of time what is `latency` seconds old; the
    estimate is predicted from there. What is older than what was released is lost."""

    def __init__(self, world: World, latency: float):
        self.world, self.kf, self.latency = world, filterpy_filter(world), latency
        self.waiting: list[tuple[float, int, np.ndarray]] = []
        self.time = self.newest = 0.0
        self.arrived = self.most = 0

    def arrive(self, now, time, value):
        self.arrived += 1
        self.newest = max(self.newest, time)
        heapq.heappush(self.waiting, (time, self.arrived, value))
        self.most = max(self.most, len(self.waiting))
        while self.waiting and self.waiting[0][0] + self.latency <= now:
            stamp, _, oldest = heapq.heappop(self.waiting)
            if stamp >= self.time:
                self._move(stamp)
                self.kf.update(oldest)
        dt = self.newest - self.time
        F = self.world.F(dt)
        return F @ self.kf.x, F @ self.kf.P @ F.T + self.world.Q(dt)

    def _move(self, time):
        dt, self.time = time - self.time, time
        self.kf.predict(F=self.world.F(dt), Q=self.world.Q(dt))

    def numbers(self) -> int:
        return self.kf.x.size + self.kf.P.size + 3 * self.most


class Kalbee:
    """kalbee's `AsyncSensorBuffer`, which sorts and filters again all that it keeps. Its own
    `KalmanFilter` has one F and Q, whatever the interval: here they follow it."""

    def __init__(self, world: World, capacity: int):
        from kalbee import AsyncSensorBuffer, KalmanFilter

        class Moving(KalmanFilter):
            def predict(self, dt=1.0, **options):
                self.transition_matrix, self.transition_covariance = world.F(dt), world.Q(dt)
                return super().predict(dt=dt, **options)

        mean = world.mean[:, None]
        kf = Moving(mean, world.cov, world.F(1.0), world.Q(1.0), world.H, world.R)
        self.buffer = AsyncSensorBuffer(kf, buffer_capacity=capacity)
        self.buffer.initialize(0.0, mean, world.cov)
        self.capacity, self.arrived = capacity, 0

    def arrive(self, now, time, value):
        self.arrived += 1
        mean, cov = self.buffer.add_measurement(time, value[:, None])
        return mean[:, 0], cov

    def numbers(self) -> int:
        return 2 * (4 + 16) + 3 * min(self.capacity, self.arrived)


class StoneSoup:
    """Stone Soup's Kalman filter of the accumulated state density (Koch & Govaers), with as many
    past times as ours; what is older is left out. It stacks [x, vx, y, vy]."""

    ORDER = (0, 2, 1, 3)

    def __init__(self, world: World):
        from stonesoup.models.measurement.linear import LinearGaussian
        from stonesoup.models.transition.linear import (
            CombinedLinearGaussianTransitionModel,
            ConstantVelocity,
        )
        from stonesoup.predictor.asd import ASDKalmanPredictor
        from stonesoup.types.state import ASDGaussianState
        from stonesoup.updater.asd import ASDKalmanUpdater

        axis = ConstantVelocity(world.q)
        self.predictor = ASDKalmanPredictor(CombinedLinearGaussianTransitionModel([axis, axis]))
        self.updater = ASDKalmanUpdater(LinearGaussian(4, mapping=(0, 2), noise_covar=world.R))
        self.state = ASDGaussianState(
            multi_state_vector=world.mean[list(self.ORDER)][:, None],
            multi_covar=world.cov[np.ix_(self.ORDER, self.ORDER)],
            timestamps=[START],
            max_nstep=LAG + 1,
        )

    def arrive(self, now, time, value):
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis

        stamp = START + timedelta(microseconds=round(float(time) * 1e6))
        if stamp >= self.state.timestamps[-1]:
            prediction = self.predictor.predict(self.state, timestamp=stamp)
            detection = Detection(value[:, None], timestamp=stamp)
            self.state = self.updater.update(SingleHypothesis(prediction, detection))
        mean = np.asarray(self.state.state_vector, float)[list(self.ORDER), 0]
        return mean, np.asarray(self.state.covar, float)[np.ix_(self.ORDER, self.ORDER)]

    def numbers(self) -> int:
        kept = sum(x.size for d in self.state.correlation_matrices for x in d.values())
        return self.state.multi_state_vector.size + self.state.multi_covar.size + kept


OTHERS: dict[str, Sequence[Build]] = {
    "FilterPy (late as current)": [FilterPyNaive],
    "FilterPy buffer (tuned)": [
        partial(FilterPyBuffer, latency=latency) for latency in (0.0, 1.0, 2.0, 4.0, 8.0)
    ],
    "kalbee buffer (50)": [partial(Kalbee, capacity=50)],
    "Stone Soup ASD": [StoneSoup],
}
"""By the name of their row; of several candidates the best on other runs is taken. All of a linear
world with one sensor."""
