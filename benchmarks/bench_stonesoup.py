"""Time late data against Stone Soup: ``python -m benchmarks.bench_stonesoup [--quick]``.

The peer is its Kalman filter of the accumulated state density (Koch & Govaers), the method of
`asd`, on the same stream (L2: irregular times, 30 % late, process noise by run) with as many past
times, one run after another in float64. All leave out what is older than those times. Its clock
counts whole microseconds, so the times of the stream are rounded to them.

In order of time the means must agree to 1e-6 standard deviations of the filter. With late data
ours must agree with each other; the peer's differ (it predicts the inserted state from the
smoothed density of its neighbour, which has seen the later data already) and the note says by how
much. Read the ratios within one table.
"""

import argparse
from collections.abc import Callable
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path

import jax
import numpy as np

import ewif_jax as ej
from benchmarks import ours
from benchmarks.bench_late import in_sequence
from benchmarks.timing import measure, report
from benchmarks.workloads import L2, irregular_and_late

OUTPUT = Path(__file__).parent / "results" / "stonesoup.json"
PEER = "Stone Soup ASD"
LAG = 8
ORDER = (0, 3, 1, 4, 2, 5)
"""where Stone Soup, which stacks axis by axis, has the components of our state"""


def main() -> None:
    """Check that the means agree, time everything, print the table and write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, help="512, or 64 with --quick")
    parser.add_argument("--steps", type=int, help="500, or 100 with --quick")
    parser.add_argument("--chunk", type=int, default=256, help="runs in one batch")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    ej.prepare_cpu(1)
    runs = options.runs or (64 if options.quick else 512)
    steps = options.steps or (100 if options.quick else 500)
    jax.config.update("jax_enable_x64", True)
    work = in_microseconds(irregular_and_late(runs, steps, dtype=np.float64))
    two = some(work, slice(2))
    in_order, late = differences(in_sequence(two)), differences(two)
    print(f"means, in standard deviations: in sequence {in_order}, late {late}")
    if max(*in_order.values(), late["asd and replay"]) > 1e-6:
        raise SystemExit("the filters do not agree")
    results = []
    note = f"off the exact means by up to {late['asd and peer']:.1g} standard deviations"
    timed = rows(work, options.chunk)
    times = measure({name: fn for name, fn, _ in timed}, options.repeat, budget=20.0)
    for name, _, count in timed:
        row = {"workload": "L2", "name": name, "run_steps": count * steps}
        row["note"] = note if name == PEER else ""
        results.append(row | times[name])
    report(results, options.output, references=(PEER,))


def methods() -> dict[str, ej.Estimator]:
    """Ours, exact as the peer."""
    model = ours.model()
    return {"asd": ej.asd(model, LAG), "replay": ej.replay(ej.kalman(model), LAG, width=2)}


def rows(work: L2, chunk: int) -> list[tuple[str, Callable[[], object], int]]:
    """Name, filter and number of runs of what is timed."""
    found: list[tuple[str, Callable[[], object], int]] = [
        (PEER, partial(stonesoup_means, some(work, slice(1))), 1)
    ]
    runs = len(work.q)
    for dtype in (np.float32, np.float64):
        cast = L2(*(x if x.dtype == bool else x.astype(dtype) for x in work))
        parts = [some(cast, slice(k, k + chunk)) for k in range(0, runs, chunk)]
        for name, method in methods().items():
            filters = [ours.batch_filter(method, {"q": p.q}, p, per_run=True) for p in parts]
            found.append((f"{name}, {np.dtype(dtype).name}", partial(one_by_one, filters), runs))
    return found


def one_by_one(filters: list[Callable[[], jax.Array]]) -> list[np.ndarray]:
    """The means of every chunk, on the host: only one chunk is in the device's memory."""
    return [np.asarray(means()) for means in filters]


def differences(work: L2) -> dict[str, float]:
    """Largest differences of the means, in standard deviations of the filter."""
    theirs, found, spread = stonesoup_means(work), {}, np.ones(())
    for name, method in methods().items():
        trace = ej.run_batch(
            method,
            {"q": work.q},
            ours.stream(work),
            prior=ej.Gaussian(work.prior_mean, work.prior_cov),
            t0=0.0,
            params_per_run=True,
            devices=1,
        )
        found[name] = np.asarray(trace.mean)
        spread = np.sqrt(np.diagonal(np.asarray(trace.cov), axis1=2, axis2=3))
    return {
        "asd and peer": float(np.max(np.abs(found["asd"] - theirs) / spread)),
        "asd and replay": float(np.max(np.abs(found["asd"] - found["replay"]) / spread)),
    }


def stonesoup_means(work: L2) -> np.ndarray:
    """Means (runs, steps, 6) after each arrival, at the newest time so far."""
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import (
        CombinedLinearGaussianTransitionModel,
        ConstantAcceleration,
    )
    from stonesoup.predictor.asd import ASDKalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import ASDGaussianState
    from stonesoup.updater.asd import ASDKalmanUpdater

    start = datetime(2000, 1, 1)
    updater = ASDKalmanUpdater(LinearGaussian(6, mapping=(0, 3), noise_covar=work.R))
    axis_by_axis = np.argsort(ORDER)

    def filter_one(run: int) -> np.ndarray:
        axis = ConstantAcceleration(float(work.q[run]))
        predictor = ASDKalmanPredictor(CombinedLinearGaussianTransitionModel([axis, axis]))
        state = ASDGaussianState(
            multi_state_vector=work.prior_mean[axis_by_axis][:, None],
            multi_covar=work.prior_cov[np.ix_(axis_by_axis, axis_by_axis)],
            timestamps=[start],
            max_nstep=LAG + 1,
        )
        means = []
        for time, value in zip(work.time[run], work.value[run], strict=True):
            stamp = start + timedelta(microseconds=round(float(time) * 1e6))
            if stamp >= state.timestamps[-1]:
                prediction = predictor.predict(state, timestamp=stamp)
                detection = Detection(value[:, None], timestamp=stamp)
                state = updater.update(SingleHypothesis(prediction, detection))
            means.append(np.asarray(state.state_vector, float)[list(ORDER), 0])
        return np.stack(means)

    return np.stack([filter_one(run) for run in range(len(work.q))])


def some(work: L2, which: slice) -> L2:
    """Some runs of a workload."""
    by_run = ("time", "arrival", "value", "delayed", "truth", "q")
    return work._replace(**{name: getattr(work, name)[which] for name in by_run})


def in_microseconds(work: L2) -> L2:
    """The workload with times that a `datetime` can hold."""
    return work._replace(time=np.round(work.time, 6))


if __name__ == "__main__":
    main()
