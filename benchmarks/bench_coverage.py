"""Coverage of the intervals of `standard_errors`: ``python -m benchmarks.bench_coverage``.

Two cases, each over many simulated data sets: log q and log r of constant velocity (120 rows, 30 %
late), by the observed information; and tau of the sine, by the sandwich over 50 runs a data set,
against the tau that maximises the likelihood of 100,000 runs (it is no model of the sine).
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import ewif_jax as ej
from ewif_jax.study.shared.fits import fitted

OUTPUT = Path(__file__).parent / "results" / "coverage.json"
ROWS, LATE = 120, 0.3
Q, R = 0.5, 1.0


def told(name: str, inside: np.ndarray, extra: dict[str, Any]) -> dict[str, Any]:
    """Prints and returns how often an interval held the value."""
    share = float(inside.mean())
    error = float(np.sqrt(share * (1 - share) / len(inside)))
    print(f"{name}: {share:.1%} +- {error:.1%} of {len(inside)} intervals of 95 %; {extra}")
    return {"name": name, "coverage": share, "error": error, "data_sets": len(inside), **extra}


def of_variances(count: int, seed: int) -> list[dict[str, Any]]:
    """Log q and log r of constant velocity, late data in their order of arrival."""
    rng = np.random.default_rng(seed)
    times = np.arange(1.0, ROWS + 1)
    late = np.where(rng.uniform(size=ROWS) < LATE, rng.uniform(0.5, 3.0, ROWS), 0)
    order = np.argsort(times + late, kind="stable")
    root = np.linalg.cholesky(Q * np.array([[1 / 3, 1 / 2], [1 / 2, 1]]))
    state, values = rng.normal(size=(count, 2)), []
    for _ in range(ROWS):
        state = state @ np.array([[1, 1], [0, 1]]).T + rng.normal(size=(count, 2)) @ root.T
        values.append(state[:, 0] + np.sqrt(R) * rng.normal(size=count))
    value = np.stack(values, 1)[:, order, None]
    model = ej.models.constant_velocity(
        sensors=ej.models.position_sensor(lambda p: p["r"]), q=lambda p: p["q"]
    )
    estimator, prior = ej.asd(model, 8), ej.Gaussian(np.zeros(2), np.eye(2))
    shared = (times[order], np.zeros(ROWS, np.int32), np.ones((ROWS, 1), bool))
    setting = {"prior": prior, "t0": 0.0}

    def stream(own: Any) -> ej.Measurement:
        return ej.Measurement(shared[0], own, shared[1], shared[2])

    def loss(x: Any, own: Any) -> Any:
        params = {"q": jnp.exp(x[0]), "r": jnp.exp(x[1])}
        return -ej.log_likelihood(estimator, params, stream(own), **setting) / ROWS

    found = fitted(loss, np.log([1.0, 1.0]), value).point
    inside, seconds = [], []
    for x, own in zip(found, value, strict=True):
        begun = time.perf_counter()
        params = {"q": np.exp(x[0]), "r": np.exp(x[1])}
        errors = ej.standard_errors(estimator, params, stream(own), **setting)
        logs = errors.derived(lambda p: jnp.log(jnp.stack([p["q"], p["r"]])))
        low, high = logs.interval(0.95)
        seconds.append(time.perf_counter() - begun)
        truth = np.log([Q, R])
        inside.append((np.asarray(low) <= truth) & (truth <= np.asarray(high)))
    held = np.stack(inside)
    extra = {"seconds_first": round(seconds[0], 2), "seconds_later": round(np.median(seconds), 4)}
    return [told(f"log {name}", held[:, k], extra) for k, name in enumerate("qr")]


def of_tau(count: int, runs: int, many: int, seed: int) -> list[dict[str, Any]]:
    """tau of the sine by its likelihood, which is no model of it."""
    model, scenario = ej.scenarios.sine_model(), ej.scenarios.sine()
    estimator = ej.ewif(model, lambda p: p["tau"])
    setting = {"prior": None, "t0": 0.0}

    def drawn(key: Any, number: int) -> ej.Measurement:
        return ej.simulate_batch(scenario, jax.random.split(key, number)).measurements

    batch = drawn(jax.random.key(seed), many)
    loss = ej.likelihood_loss(estimator, batch, **setting)
    best = float(ej.tune(loss, {"tau": 0.5}).params["tau"])
    every = drawn(jax.random.key(seed + 1), count * runs)
    value = np.asarray(every.value).reshape(count, runs, *every.value.shape[1:])
    time_, sensor, mask = (np.asarray(x) for x in (every.time, every.sensor, every.mask))
    time_, sensor, mask = (
        x[0] if x.ndim > n else x for x, n in ((time_, 1), (sensor, 1), (mask, 2))
    )

    def stream(own: Any) -> ej.Measurement:
        return ej.Measurement(time_, own, sensor, mask)

    def loss_of(x: Any, own: Any) -> Any:
        total = ej.log_likelihood(estimator, {"tau": jnp.exp(x[0])}, stream(own), **setting)
        return -total / (runs * len(time_))

    found = fitted(loss_of, np.log([best]), value, at_once=50).point
    inside, seconds = [], []
    for x, own in zip(found, value, strict=True):
        begun = time.perf_counter()
        errors = ej.standard_errors(
            estimator, {"tau": np.exp(x[0])}, stream(own), kind="sandwich", **setting
        )
        low, high = errors.interval(0.95)
        seconds.append(time.perf_counter() - begun)
        inside.append(float(low["tau"]) <= best <= float(high["tau"]))
    extra = {
        "tau": round(best, 4),
        "seconds_first": round(seconds[0], 2),
        "seconds_later": round(np.median(seconds), 4),
    }
    return [told("tau", np.asarray(inside), extra)]


def main() -> None:
    """Prints the coverage of both cases, and saves it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--many", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=("variances", "tau"))
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"seed {options.seed}, jax {jax.__version__}")
    rows = []
    if options.only != "tau":
        rows += of_variances(options.sets, options.seed)
    if options.only != "variances":
        rows += of_tau(options.sets, options.runs, options.many, options.seed)
    about = {"seed": options.seed, "jax": jax.__version__}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps([{**row, **about} for row in rows], indent=1))


if __name__ == "__main__":
    main()
