"""What outliers and a jump of the target cost: ``python -m benchmarks.bench_outliers [--runs N]``.

Position of a target of nearly constant velocity (q = 0.05 m^2/s^3), seen once a second with 1 m,
20 % of the rows 1 to 3 s late, by `asd` behind a gate, or robust. Worlds: as modelled; 5 % outliers
of 20 m; bursts of 1 to 8 rows in a row that all err by the same 30 m; a jump of the target by 300 m
in the middle, which the model does not know, with and without outliers. Printed is the root mean
square error of the position over all rows and runs, with its standard error over runs, and in
brackets the same over the last quarter.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

import ewif_jax as ej

OUTPUT = Path(__file__).parent / "results" / "outliers.json"
T, Q, LAG = 120, 0.05, 6
WORLDS = ("as modelled", "5 % outliers", "bursts", "jump", "jump and 5 % outliers")


def methods() -> dict[str, ej.Estimator]:
    """The filters that are compared, by name."""
    model = ej.models.constant_velocity(sensors=ej.models.position_sensor(1.0), q=Q)
    plain = ej.asd(model, LAG)
    return {
        "plain": plain,
        "gated, never opens": ej.gated(plain, recover_after=None),
        "gated": ej.gated(plain),
        "robust, weight, c = 3": ej.robust(plain, 3.0),
        "robust, huber, c = 1.5": ej.robust(plain, 1.5, "huber"),
        "robust, student, c = 4": ej.robust(plain, 4.0, "student"),
        "gated, robust (huber)": ej.gated(ej.robust(plain, 1.5, "huber")),
    }


def drawn(world: str, runs: int, seed: int) -> tuple[ej.Measurement, np.ndarray]:
    """The streams (R, T) and the position at each newest time (R, T)."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(Q * np.array([[1 / 3, 1 / 2], [1 / 2, 1]]))
    state, path = rng.normal(size=(runs, 2)), []
    for k in range(T):
        state = state @ np.array([[1, 0], [1, 1]]) + rng.normal(size=(runs, 2)) @ root.T
        state[:, 0] += 300 * ("jump" in world and k == T // 2)
        path.append(state[:, 0])
    truth = np.stack(path, 1)
    value = truth + rng.normal(size=(runs, T))
    if "outliers" in world:
        value += 20 * rng.normal(size=(runs, T)) * (rng.random((runs, T)) < 0.05)
    if world == "bursts":
        for row in value:
            for start in np.flatnonzero(rng.random(T) < 0.015):
                row[start : start + rng.integers(1, 9)] += 30 * rng.choice([-1, 1])
    late = np.where(rng.random(T) < 0.2, rng.uniform(1, 3, T), 0)
    order = np.argsort(np.arange(T) + late, kind="stable")
    newest = np.maximum.accumulate(order)
    data = ej.Measurement(
        np.arange(1.0, T + 1)[order],
        value[:, order, None],
        np.zeros(T, np.int32),
        np.ones((T, 1), bool),
    )
    return data, truth[:, newest]


def root_mean_square(error: np.ndarray) -> tuple[float, float]:
    """Over rows and runs (R, T), and its standard error over runs."""
    squares = (error**2).mean(1)
    root = float(np.sqrt(squares.mean()))
    return root, float(squares.std(ddof=1) / np.sqrt(len(squares)) / (2 * root))


def measured(world: str, runs: int, seed: int) -> list[dict[str, Any]]:
    """A row for each filter."""
    data, truth = drawn(world, runs, seed)
    prior, rows = ej.Gaussian(np.zeros(2), np.eye(2)), []
    for name, estimator in methods().items():
        trace = ej.run_batch(estimator, None, data, prior=prior, t0=0.0)
        error = np.asarray(trace.mean[..., 0]) - truth
        every, last = root_mean_square(error), root_mean_square(error[:, -T // 4 :])
        refused = float((np.asarray(trace.info.status) == ej.Status.REJECTED).mean())
        rows.append(
            {"world": world, "method": name, "rmse": every, "last": last, "refused": refused}
        )
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown: a line for each filter, a column for each world."""
    names = dict.fromkeys(row["method"] for row in rows)
    lines = ["| | " + " | ".join(WORLDS) + " |", "|---" * (len(WORLDS) + 1) + "|"]
    for name in names:
        own = {row["world"]: row for row in rows if row["method"] == name}
        cells = [
            f"{own[w]['rmse'][0]:.2f} ± {own[w]['rmse'][1]:.2f}"
            f" ({own[w]['last'][0]:.2f})" for w in WORLDS
        ]  # fmt: skip
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Prints the table and writes it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = [row for w in WORLDS for row in measured(w, arguments.runs, arguments.seed)]
    print(table(rows))
    OUTPUT.parent.mkdir(exist_ok=True)
    OUTPUT.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
