"""Peak memory of `monte_carlo` with metrics only: ``python -m benchmarks.bench_memory``.

Each figure is the peak resident size of a fresh process, less that of the smallest study: flat in
the number of runs and in the steps of a run.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from benchmarks.timing import environment

OUTPUT = Path(__file__).parent / "results" / "memory.json"
SIZES = ((64, 100), (1024, 1000), (4096, 1000), (16384, 1000), (1024, 4000), (1024, 16000))
STUDY = """
import resource
import jax
import jax.numpy as jnp
import ewif_jax as ej
runs, steps = {runs}, {steps}
model = ej.models.constant_velocity(sensors=ej.models.position_sensor(1.0), q=0.1)
prior = ej.Gaussian(jnp.zeros(2), jnp.eye(2))
time = jnp.arange(1.0, steps + 1) * 0.1

def simulate(key):
    truth = jnp.sin(time)[:, None]
    value = truth + jax.random.normal(key, (steps, 1))
    mask = jnp.ones((steps, 1), bool)
    return ej.Simulation(ej.Measurement(time, value, jnp.zeros(steps, int), mask), truth, None)

scenario = ej.Scenario(simulate, prior, 0.0)
ej.monte_carlo(ej.kalman(model), None, scenario, runs=runs, key=jax.random.key(0))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def main() -> None:
    """Run every size in its own process, print a table and write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    rows = []
    for runs, steps in SIZES:
        code = STUDY.format(runs=runs, steps=steps)
        done = subprocess.run(
            [sys.executable, "-c", code], check=True, capture_output=True, text=True
        )
        rows.append({"runs": runs, "steps": steps, "peak_mib": float(done.stdout)})
        extra = rows[-1]["peak_mib"] - rows[0]["peak_mib"]
        print(f"{runs:6d} runs x {steps:6d} steps: {rows[-1]['peak_mib']:7.0f} MiB (+{extra:.0f})")
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(
        json.dumps({"environment": environment(), "results": rows}, indent=2) + "\n"
    )


if __name__ == "__main__":
    main()
