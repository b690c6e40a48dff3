"""Time the value and gradient of an RMSE over L1 (G1): ``python -m benchmarks.bench_gradient``.

Every row is compiled as one program. `x forward` is its time over that of the loss alone.
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp

import ewif_jax as ej
from benchmarks import ours
from benchmarks.timing import measure, report
from benchmarks.workloads import constant_acceleration
from ewif_jax.tuning import value_and_gradient

OUTPUT = Path(__file__).parent / "results" / "gradient.json"


def main() -> None:
    """Time forward pass, and gradients as `tune` takes them and in reverse mode."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    ej.prepare_cpu(1)
    workload = constant_acceleration(options.runs, options.steps)
    sensor = ej.models.position_sensor(lambda p: p["r"], dims=2)
    model = ej.models.constant_acceleration(sensors=sensor, q=lambda p: p["q"], dims=2)
    prior = ej.Gaussian(workload.prior_mean, workload.prior_cov)
    cases = {
        "kalman": (ej.kalman(model), {"q": jnp.float32(0.01), "r": jnp.float32(1.0)}, "q"),
        "ewif": (
            ej.ewif(model, lambda p: p["tau"]),
            {"tau": jnp.float32(1.0), "r": jnp.float32(1.0)},
            "tau",
        ),
    }
    results = []
    for name, (estimator, params, single) in cases.items():
        loss = ej.rmse_loss(
            estimator, ours.stream(workload), workload.truth[..., :2], prior=prior, t0=0.0
        )
        rows = {
            "forward": loss,
            "value and gradient, one": lambda p, loss=loss, single=single: value_and_gradient(
                lambda x: loss(p | x), {single: p[single]}
            ),
            "value and gradient, all": lambda p, loss=loss: value_and_gradient(loss, p),
            "reverse mode, all": jax.value_and_grad(loss),
        }
        calls = {label: partial(jax.jit(fn), params) for label, fn in rows.items()}
        for label, times in measure(calls, options.repeat).items():
            row = {"workload": f"G1 {name}", "name": label, "note": ""}
            results.append(row | {"run_steps": options.runs * options.steps} | times)
    report(results, options.output, references=("forward",))


if __name__ == "__main__":
    main()
