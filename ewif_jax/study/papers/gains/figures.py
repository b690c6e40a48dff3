"""The figures of the gains study."""

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ewif_jax.study.shared.figures import OTHER, TRUTH, label, study_canvas


def low(case: Any, ages: np.ndarray, gains: np.ndarray, closed_form: Callable) -> Figure:
    """Fig. 1: four sequences and the approximation (1 - lambda)^(T / dT) lambda."""
    figure, axes = study_canvas(width=7, height=4.2)
    for age, gain in zip(ages[:4], gains[:4, :, 0], strict=True):
        axes.semilogy(age, gain, ".--", color=OTHER, linewidth=0.7, markersize=3)
    line = np.linspace(0, ages[:4].max(), 100)
    index = 0.1 * np.sqrt(case.interval)
    simple = (1 - index) ** (line / case.interval) * index
    axes.semilogy(line, simple, color=TRUTH, linewidth=2, label="(1 - λ)^(T/ΔT) λ")
    exact = closed_form(case, line)[:, 0]
    axes.semilogy(line, exact, color="#d6604d", linestyle=":", linewidth=2, label="eq. (7)")
    axes.plot([], [], ".--", color=OTHER, label="four Poisson sequences")
    axes.legend(frameon=False, fontsize="small")
    label(axes, "age of the measurement [s]", "gain [1]", "Random walk, λ = 0.032")
    return figure


def typical(case: Any, ages: np.ndarray, gains: np.ndarray, closed_form: Callable) -> Figure:
    """Fig. 2: five sequences, and a hundred as dots."""
    figure, axes = study_canvas(1, 2, width=11, height=4.2, sharey=True)
    for age, gain in zip(ages[:5], gains[:5, :, 0], strict=True):
        axes[0].semilogy(age, gain, ".--", color=OTHER, linewidth=0.7, markersize=4)
    axes[1].semilogy(
        ages[:100].ravel(), gains[:100, :, 0].ravel(), ".", color=OTHER, markersize=3, alpha=0.4
    )
    line = np.linspace(0, 8 * case.interval, 100)
    for ax, title in zip(axes, ("five sequences", "100 sequences"), strict=True):
        ax.semilogy(line, closed_form(case, line)[:, 0], color=TRUTH, linewidth=2, label="eq. (7)")
        ax.set_xlim(0, line[-1])
        ax.set_ylim(1e-5, 2)
        ax.legend(frameon=False)
        label(ax, "age of the measurement [s]", "", f"Random walk, λ = 1, {title}")
    axes[0].set_ylabel("gain [1]")
    return figure


def velocity(case: Any, ages: np.ndarray, gains: np.ndarray, closed_form: Callable) -> Figure:
    """Fig. 3: one sequence, gains of position and velocity."""
    figure, axes = study_canvas(1, 2, width=11, height=4.2)
    line = np.linspace(0, ages[0].max(), 200)
    theory = closed_form(case, line)
    units = ("[1]", "[1/s]")
    for i, (ax, unit) in enumerate(zip(axes, units, strict=True)):
        ax.plot(ages[0], gains[0, :, i], ".--", color=OTHER, linewidth=0.8, label="one sequence")
        ax.plot(line, theory[:, i], color=TRUTH, linewidth=2, label="eq. (5)")
        ax.legend(frameon=False)
        label(ax, "age of the measurement [s]", f"gain {unit}", case.components[i])
    return figure
