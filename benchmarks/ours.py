"""This package on the workloads, each as a callable of no arguments, like `benchmarks.peers`."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

import ewif_jax as ej
from benchmarks.workloads import L1, L2
from ewif_jax.batch import run_batch
from ewif_jax.fast.layout import on_devices

Filter = Callable[[], jax.Array]


def model() -> ej.Model:
    """The model of L1 and L2 with q from the parameters."""
    sensor = ej.models.position_sensor(1.0, dims=2)
    return ej.models.constant_acceleration(sensors=sensor, q=lambda p: p["q"], dims=2)


def seen_mean(step, _):
    """What the linear workloads ask for: the filtered means."""
    return step.mean


def stream(workload: L1 | L2, devices: int = 1) -> ej.Measurement:
    """The workload's measurements, on their devices; times are shared by the runs where they are in
    the workload."""
    shape = workload.value.shape
    return placed(
        ej.Measurement(
            workload.time, workload.value, np.zeros(shape[1], np.int32), np.ones(shape[1:], bool)
        ),
        ej.Measurement(np.ndim(workload.time) == 2, True, False, False),
        devices,
    )


def placed(tree: Any, per_run: Any, devices: int = 1) -> Any:
    """The arrays of a pytree on the first devices, what is marked as per run split over them."""
    if devices == 1:
        return jax.device_put(tree, jax.devices()[0])
    return on_devices(tree, per_run, devices)


def kalman_filter(workload: L1, devices: int = 1) -> Filter:
    """Return `kalman` through `run_batch`: the filtered means (runs, steps, 6)."""
    params, prior = placed(
        ({"q": workload.q}, ej.Gaussian(workload.prior_mean, workload.prior_cov)),
        ({"q": workload.per_run}, ej.Gaussian(False, False)),
        devices,
    )
    return partial(
        run_batch,
        ej.kalman(model()),
        params,
        stream(workload, devices),
        prior=prior,
        t0=0.0,
        params_per_run=workload.per_run,
        observe=seen_mean,
        devices=devices,
    )


def batch_filter(
    estimator: ej.Estimator, params: dict, workload: L2, per_run: bool, **options
) -> Filter:
    """Return any estimator on L2: means reported at the running maximum of the times."""
    return partial(
        run_batch,
        estimator,
        params,
        stream(workload),
        prior=ej.Gaussian(workload.prior_mean, workload.prior_cov),
        t0=0.0,
        params_per_run=per_run,
        observe=seen_mean,
        devices=1,
        **options,
    )
