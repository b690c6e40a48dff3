"""The figures of the front page and of `docs/concepts.md`, drawn by the package from a fixed seed.

Run from the top folder: `python docs/figures/draw.py` (extra `lab`).
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np

import ewif_jax as ej

HERE = Path(__file__).parent
SEED = 4
BLUE, ORANGE, GREEN, GREY, RED = "#3f51b5", "#f4511e", "#2e7d6b", "#9e9e9e", "#c62828"
STATUS_COLOURS = {
    "USED": BLUE, "LATE_USED": GREEN, "TOO_LATE": RED, "REJECTED": ORANGE, "MASKED": GREY,
}  # fmt: skip


def save(figure: plt.Figure, name: str) -> None:
    """As SVG, the same bytes for the same numbers."""
    figure.savefig(HERE / name, bbox_inches="tight", metadata={"Date": None, "Creator": None})
    plt.close(figure)


def late_track() -> None:
    """A turning target, one prompt and one late sensor: late data dropped, and used."""
    rng = np.random.default_rng(SEED)
    time = np.arange(0.0, 60.0, 0.5)
    late = np.arange(120) % 3 != 0  # two of three come from the late sensor, the precise one
    truth = np.stack([40 * np.sin(time / 14), 22 * np.sin(time / 7)], 1)
    value = truth + np.where(late, 0.7, 6.0)[:, None] * rng.normal(size=(120, 2))
    arrival = time + np.where(late, 2.25, 0.0)
    order = np.asarray(ej.arrival_order(arrival))
    stream = ej.stream(time, value, sensor=late.astype(int), arrival=arrival)
    position = ej.models.position_sensor
    model = ej.models.constant_velocity(
        dims=2, q=1.0, sensors=[position(36.0, dims=2), position(0.5, dims=2)]
    )
    at = {"prior": ej.Gaussian(np.zeros(4), 400 * np.eye(4)), "t0": 0.0}
    now = arrival[order]
    there = np.stack([40 * np.sin(now / 14), 22 * np.sin(now / 7)], 1)
    figure, axis = plt.subplots(figsize=(7.2, 4.2))
    axis.plot(*truth.T, "k", lw=1.2, label="truth")
    axis.plot(*value[~late].T, "o", ms=4, color=GREY, label="measured, at once, 6 m")
    axis.plot(*value[late].T, "+", ms=6, color=GREY, label="measured, 2.25 s late, 0.7 m")
    for name, colour, estimator in (
        ("late data dropped", ORANGE, ej.drop_late(ej.kalman(model))),
        ("late data used", BLUE, ej.asd(model, 12)),
    ):
        trace = ej.run(estimator, None, stream, times=now, clock="arrival", **at)
        mean = np.asarray(trace.mean)[15:, :2]
        error = float(ej.rmse(mean, there[15:]))
        axis.plot(*mean.T, color=colour, lw=1.8, label=f"{name}: RMSE {error:.1f} m")
    axis.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axis.legend(fontsize=9, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.15))
    save(figure, "late-track.svg")


def clocks() -> None:
    """When measurements were true, when they came, and what became of them."""
    time = np.array([0.0, 1.0, 2.0, 1.5, 3.0, 4.0, 0.5, 5.0, 6.0])
    value = np.array([0.1, 0.9, 2.1, 1.4, np.nan, 4.1, 0.6, 25.0, 6.0])
    arrival = np.array([0.2, 1.2, 2.2, 2.8, 3.2, 4.2, 4.9, 5.5, 6.2])
    model = ej.models.constant_velocity(q=0.1, sensors=ej.models.position_sensor(0.1))
    estimator = ej.gated(ej.al1(model, lag=2))
    prior = ej.Gaussian(np.zeros(2), np.eye(2))
    trace = ej.run(estimator, None, ej.stream(time, value), prior=prior, t0=0.0)
    names = [ej.Status(s).name for s in trace.info.status]
    figure, axis = plt.subplots(figsize=(7.2, 3.2))
    for true, came, name in zip(time, arrival, names, strict=True):
        colour = STATUS_COLOURS[name]
        axis.annotate(
            "", (came, 0), (true, 1), arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.6}
        )
        axis.plot(true, 1, "o", color=colour, ms=6)
        axis.text(true, 1.07, f"{true:g}", ha="center", fontsize=8)
    for name in dict.fromkeys(names):
        axis.plot([], [], "o-", color=STATUS_COLOURS[name], label=name)
    moved = np.asarray(trace.time)
    axis.step(arrival, -0.25 - 0.1 * moved, where="post", color="k", lw=1.2)
    axis.text(6.35, -0.25 - 0.1 * moved[-1], "time of the estimate", va="center", fontsize=8)
    axis.set(
        xlim=(-0.3, 7.9), ylim=(-1.0, 1.25), yticks=[0, 1],
        yticklabels=["arrives", "is true"], xlabel="time (s)",
    )  # fmt: skip
    axis.legend(fontsize=9, ncols=5, loc="upper center", bbox_to_anchor=(0.45, -0.2))
    for side in ("top", "right", "left"):
        axis.spines[side].set_visible(False)
    save(figure, "clocks.svg")


def ellipse(mean: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """The points of one standard deviation around a mean, (2, 100)."""
    angle = np.linspace(0, 2 * np.pi, 100)
    return mean[:, None] + np.linalg.cholesky(cov) @ np.stack([np.cos(angle), np.sin(angle)])


def information() -> None:
    """Two measurements of a place, each precise in one direction, and what they say together."""
    means = np.array([[0.0, 0.2], [0.6, -0.1]])
    covs = np.array([[[1.0, 0.0], [0.0, 0.06]], [[0.08, 0.02], [0.02, 0.9]]])
    matrices = np.linalg.inv(covs)
    cov = np.linalg.inv(matrices.sum(0))
    mean = cov @ np.einsum("kij,kj->i", matrices, means)
    figure, axis = plt.subplots(figsize=(4.8, 3.4))
    for k, colour in enumerate((ORANGE, GREEN)):
        axis.plot(*ellipse(means[k], covs[k]), color=colour, label=f"measurement {k + 1}")
        axis.plot(*means[k], "+", color=colour)
    axis.fill(*ellipse(mean, cov), color=BLUE, alpha=0.35, label="their information added")
    axis.plot(*mean, "o", color=BLUE, ms=4)
    axis.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, "information.svg")


def forgetting() -> None:
    """What measurements count in an EWIF, the late one too, and estimates for three tau."""
    scenario = ej.scenarios.sine()
    time, truth = ej.scenarios.sine_signal()
    stream = scenario.simulate(jax.random.key(SEED)).measurements
    estimator = ej.ewif(ej.scenarios.sine_model(), tau=lambda params: params["tau"])
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.0))
    ages = np.linspace(0, 6, 100)
    taus = dict(zip((0.1, 0.5, 2.5), (ORANGE, BLUE, GREEN), strict=True))
    right.plot(time, truth[:, 0], "k", lw=1.2, label="truth")
    right.plot(time, stream.value[:, 0], ".", ms=3, color=GREY, label="measured")
    for tau, colour in taus.items():
        left.plot(ages, np.exp(-ages / tau), color=colour, label=f"tau = {tau} s")
        trace = ej.run(estimator, {"tau": jnp.float32(tau)}, stream, prior=None, t0=0.0)
        right.plot(time, trace.mean[:, 0], color=colour, lw=1.4)
    left.set(xlabel="age of a measurement (s)", ylabel="what it counts, exp(-age / tau)")
    left.legend(fontsize=8)
    right.set(xlabel="time (s)", ylabel="signal")
    right.legend(fontsize=8)
    figure.tight_layout()
    save(figure, "forgetting.svg")


if __name__ == "__main__":
    matplotlib.rcParams.update({"svg.hashsalt": "ewif_jax", "svg.fonttype": "none", "font.size": 9})
    for draw in (late_track, clocks, information, forgetting):
        draw()
