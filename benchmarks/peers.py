"""Other people's Kalman filters on L1, each as a callable that returns all filtered means.

Every function here takes the workload, does what needs doing once (conversion, transfer), and
returns a callable of no arguments. Its result has shape ``(runs, steps, 6)``. The packages
that take one run at a time filter only the first few runs (`TIMED_RUNS`): what a run takes does not
depend on how many there are, so run-steps per second of those few hold for all.

Where a package updates first, it gets the prior predicted to the first measurement. Libraries are
imported where they are used: the other peers can be timed without one that is missing.
"""

from collections.abc import Callable
from datetime import datetime, timedelta
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as Spec

from benchmarks.workloads import L1, constant_acceleration

Filter = Callable[[], "jax.Array | np.ndarray"]
TIMED_RUNS = {"filterpy": 4, "Stone Soup": 2}


def dynamax_filter(workload: L1, devices: int = 1) -> Filter:
    """Return ``lgssm_filter`` under vmap over the data, and over Q and the prior if per run."""
    from dynamax.linear_gaussian_ssm import lgssm_filter
    from dynamax.linear_gaussian_ssm.inference import make_lgssm_params

    def filter_one(shared, noise, value):
        params = make_lgssm_params(
            shared["mean"], noise["cov"], shared["F"], noise["Q"], shared["H"], shared["R"]
        )
        return lgssm_filter(params, value).filtered_means

    mean, cov = _predicted_prior(workload)
    shared = {"mean": mean, "F": workload.F, "H": workload.H, "R": workload.R}
    return _over_runs(filter_one, workload, shared, {"cov": cov, "Q": workload.Q}, devices)


def scan_solve_filter(workload: L1, devices: int = 1) -> Filter:
    """Return the Kalman equations as printed, in ``scan`` with ``jnp.linalg.solve``, under vmap."""

    def filter_one(shared, noise, value):
        F, H, R, Q = shared["F"], shared["H"], shared["R"], noise["Q"]

        def step(carry, z):
            mean, cov = carry
            mean, cov = F @ mean, F @ cov @ F.T + Q
            gain = jnp.linalg.solve(H @ cov @ H.T + R, H @ cov).T
            mean, cov = mean + gain @ (z - H @ mean), cov - gain @ H @ cov
            return (mean, cov), mean

        return jax.lax.scan(step, (shared["mean"], shared["cov"]), value)[1]

    shared = {
        "mean": workload.prior_mean,
        "cov": workload.prior_cov,
        "F": workload.F,
        "H": workload.H,
        "R": workload.R,
    }
    return _over_runs(filter_one, workload, shared, {"Q": workload.Q}, devices)


def cuthbert_filter(workload: L1) -> Filter:
    """Return cuthbert's square-root Kalman filter, sequential in time, under vmap.

    One device only: with 256 runs split over two host devices on two cores (jaxlib 0.10.2) the
    call never returned, with all threads idle.
    """
    import cuthbert
    from cuthbert.gaussian import kalman

    def filter_one(shared, noise, value):
        filter_object = kalman.build_filter(
            shared["mean"],
            shared["chol_cov"],
            lambda z: (shared["F"], jnp.zeros(6, z.dtype), noise["chol_Q"]),
            lambda z: (shared["H"], jnp.zeros(2, z.dtype), shared["chol_R"], z),
        )
        states = cuthbert.filter(filter_object, value, filter_object.init_prepare(), parallel=False)
        return states.mean[1:]  # the first is the prior

    shared = {
        "mean": workload.prior_mean,
        "chol_cov": np.linalg.cholesky(workload.prior_cov),
        "F": workload.F,
        "H": workload.H,
        "chol_R": np.linalg.cholesky(workload.R),
    }
    return _over_runs(filter_one, workload, shared, {"chol_Q": workload.chol_Q})


def simdkalman_filter(workload: L1) -> Filter:
    """Return simdkalman: NumPy over all runs at once, float64."""
    import simdkalman

    mean, cov = _predicted_prior(workload)
    kalman = simdkalman.KalmanFilter(workload.F, workload.Q, workload.H, workload.R)

    def call():
        result = kalman.compute(
            workload.value,
            0,
            initial_value=mean,
            initial_covariance=cov,
            smoothed=False,
            filtered=True,
            covariances=False,
            observations=False,
        )
        return result.filtered.states.mean

    return call


def filterpy_filter(workload: L1, runs: int = TIMED_RUNS["filterpy"]) -> Filter:
    """Return filterpy's ``KalmanFilter.batch_filter`` over the first `runs` runs in turn."""
    from filterpy.kalman import KalmanFilter

    def filter_one(run):
        kalman = KalmanFilter(dim_x=6, dim_z=2)
        kalman.x, kalman.P = workload.prior_mean.copy(), workload.prior_cov.copy()
        kalman.F, kalman.H, kalman.R = workload.F, workload.H, workload.R
        kalman.Q = _of_run(workload.Q, run)
        return kalman.batch_filter(workload.value[run])[0]

    return lambda: np.stack([filter_one(run) for run in range(min(runs, len(workload.value)))])


def stonesoup_filter(workload: L1, runs: int = TIMED_RUNS["Stone Soup"]) -> Filter:
    """Return Stone Soup's Kalman predictor and updater over the first `runs` runs in turn."""
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater

    start = datetime(2000, 1, 1)
    times = [start + timedelta(seconds=float(seconds)) for seconds in workload.time]
    updater = KalmanUpdater(LinearGaussian(6, mapping=(0, 1), noise_covar=workload.R))
    detections = [
        [Detection(z[:, None], timestamp=t) for z, t in zip(series, times, strict=True)]
        for series in workload.value[:runs]
    ]

    def filter_one(run):
        predictor = KalmanPredictor(
            LinearGaussianTimeInvariantTransitionModel(
                transition_matrix=workload.F, covariance_matrix=_of_run(workload.Q, run)
            )
        )
        state = GaussianState(workload.prior_mean[:, None], workload.prior_cov, timestamp=start)
        means = []
        for detection in detections[run]:
            prediction = predictor.predict(state, timestamp=detection.timestamp)
            state = updater.update(SingleHypothesis(prediction, detection))
            means.append(np.asarray(state.state_vector)[:, 0])
        return np.stack(means)

    return lambda: np.stack([filter_one(run) for run in range(len(detections))]).astype(float)


def numba_filter(workload: L1, threads: int = 1) -> Filter:
    """Return the plain Numba kernel of `numba_kernel`, on `threads` threads; float32 only."""
    import numba

    from benchmarks.numba_kernel import filter_all

    runs, steps, _ = workload.value.shape
    Q = np.broadcast_to(workload.Q, (runs, 6, 6)).transpose(1, 2, 0)
    constants = (workload.F, workload.H, workload.R, np.ascontiguousarray(Q))
    prior = (workload.prior_mean, workload.prior_cov)

    def call():
        numba.set_num_threads(threads)
        mean = np.empty((runs, steps, 6), np.float32)
        filter_all(*constants, *prior, workload.value, mean)
        return mean

    return call


SPLIT_PEERS = {"dynamax": dynamax_filter, "scan + solve": scan_solve_filter}  # take `devices`
PEERS = SPLIT_PEERS | {
    "cuthbert": cuthbert_filter,
    "simdkalman": simdkalman_filter,
    "filterpy": filterpy_filter,
    "Stone Soup": stonesoup_filter,
    "numba 1 thread": numba_filter,
    "numba 2 threads": partial(numba_filter, threads=2),
}
NOTES = {
    "cuthbert": "square root by QR",
    "simdkalman": "float64",
    "filterpy": f"{TIMED_RUNS['filterpy']} runs, scaled; float64",
    "Stone Soup": f"{TIMED_RUNS['Stone Soup']} runs, scaled; float64",
    "numba 1 thread": "practical limit",
    "numba 2 threads": "practical limit",
}


def check(
    filters: dict[str, Callable[[L1], Filter]] | None = None,
    *,
    runs: int = 70,
    steps: int = 300,
    tolerance: float = 0.01,
) -> dict[str, float]:
    """Return the largest error of each filter on small L1 (a) and (b) against a float64 NumPy loop.

    Args:
        filters: What to check, by name; `PEERS` if left out.
        runs: Not a multiple of the Numba kernel's block, so that its last block is short.
        steps: Measurements in a run.
        tolerance: Allowed error, in posterior standard deviations of the state concerned: single
            precision resolves a position of some hundreds to 1e-4 of its standard deviation.

    Returns:
        The largest error found, by name.

    Raises:
        AssertionError: An error is above `tolerance`, or a result has the wrong shape.
    """
    errors = dict.fromkeys(filters or PEERS, 0.0)
    for per_run in (False, True):
        workload = constant_acceleration(runs, steps, per_run=per_run)
        expected, deviation = _reference(workload)
        for name, build in (filters or PEERS).items():
            mean = np.asarray(build(workload)(), float)
            assert mean.shape[1:] == (steps, 6), f"{name}: shape {mean.shape}"
            count = len(mean)
            error = np.abs(mean - expected[:count]) / deviation[:count]
            errors[name] = max(errors[name], float(error.max()))
            assert error.max() <= tolerance, (
                f"{name} (per_run={per_run}): off by {error.max():.3g} standard deviations"
            )
    return errors


def _reference(workload: L1) -> tuple[np.ndarray, np.ndarray]:
    """Return means and standard deviations of all runs, in float64 with an explicit inverse."""
    F, H, Q, R, value = (
        np.asarray(array, float)
        for array in (workload.F, workload.H, workload.Q, workload.R, workload.value)
    )
    runs, steps, _ = value.shape
    mean = np.broadcast_to(workload.prior_mean.astype(float), (runs, 6))
    cov = np.broadcast_to(workload.prior_cov.astype(float), (runs, 6, 6))
    means, deviations = np.empty((2, runs, steps, 6))
    for k in range(steps):
        mean, cov = mean @ F.T, F @ cov @ F.T + Q
        gain = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + R)
        innovation = value[:, k] - mean @ H.T
        mean = mean + (gain @ innovation[..., None])[..., 0]
        cov = (np.eye(6) - gain @ H) @ cov
        means[:, k] = mean
        deviations[:, k] = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    return means, deviations


def _predicted_prior(workload: L1) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance just before the first measurement."""
    F = workload.F
    return F @ workload.prior_mean, F @ workload.prior_cov @ F.T + workload.Q


def _of_run(array: np.ndarray, run: int) -> np.ndarray:
    """Return the matrix of one run, from one shared by all or one for each."""
    return array if array.ndim == 2 else array[run]


def _over_runs(filter_one, workload: L1, shared: dict, noise: dict, devices: int = 1) -> Filter:
    """Put `filter_one` under jit and vmap with the runs leading, split evenly over `devices`.

    Args:
        filter_one: ``(shared, noise, value of one run) -> means of one run``.
        workload: Gives the measurements, and whether `noise` has an axis of runs.
        shared: Arrays that all runs share.
        noise: Arrays that have a leading axis of runs if the workload is per run.
        devices: How many JAX devices to use; must divide the runs.
    """
    batched = jax.vmap(filter_one, (None, 0 if workload.per_run else None, 0))
    arguments = (shared, noise, workload.value)
    if devices == 1:
        function, arguments = jax.jit(batched), jax.device_put(arguments, jax.devices()[0])
    else:
        mesh = jax.make_mesh((devices,), ("runs",), devices=jax.devices()[:devices])
        specs = (Spec(), Spec("runs") if workload.per_run else Spec(), Spec("runs"))
        split = jax.shard_map(
            batched, mesh=mesh, in_specs=specs, out_specs=Spec("runs"), check_vma=False
        )
        function = jax.jit(split)
        arguments = tuple(
            jax.device_put(argument, NamedSharding(mesh, spec))
            for argument, spec in zip(arguments, specs, strict=True)
        )
    return partial(function, *arguments)
