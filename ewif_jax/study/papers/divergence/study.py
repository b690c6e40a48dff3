"""Data saturation, section 4 of Anderson (1973): a filter that trusts a constant too long, and
three remedies."""

from itertools import product
from typing import Any

import numpy as np
import xarray as xr

from ewif_jax.moments import standard_error
from ewif_jax.scenarios.divergence import (
    PUSHES,
    REMEDIES,
    Push,
    Remedy,
    divergence,
    divergence_curve,
    divergence_filter,
)
from ewif_jax.study.papers.divergence import figures
from ewif_jax.study.shared.experiment import Experiment, Measured
from ewif_jax.study.shared.folder import Arrays
from ewif_jax.types import Numbers, PyTree

EPS, LENGTH = 0.3, 20.0
GAINS = np.geomspace(0.05, 5.0, 60)
"""steady gains in 1/s over which the remedies are compared"""
UNITS = {"noise": "1/s", "weighting": "1/s", "memory": "s"}
TEXT = {
    "none": "none",
    "noise": "more process noise",
    "weighting": "exponential weighting",
    "memory": "limited memory",
}


def setting_for(remedy: Remedy, gain: Numbers) -> Any:
    """The setting whose weight on the newest data settles at `gain` in 1/s: q = gain^2,
    alpha = gain / 2, or a memory of 1 / gain seconds; None where there is nothing to set."""
    return {"none": None, "noise": gain**2, "weighting": gain / 2, "memory": 1 / gain}[remedy]


def chosen_setting(remedy: Remedy, dt: float) -> float | None:
    """The setting with the least final error under the white push: gain sqrt(eps), or a memory of
    sqrt(3 / eps) s (whole samples)."""
    if remedy == "memory":
        return round(np.sqrt(3 / EPS) / dt) * dt
    return setting_for(remedy, np.sqrt(EPS))


def closed_forms(dt: float) -> dict[tuple[Push, Remedy], tuple[str, float]]:
    """Every closed form of the mean square error, as text and as a number for `EPS`: at `LENGTH`
    without a remedy, and once settled with one."""
    K, M, t = np.sqrt(EPS), chosen_setting("memory", dt) or 0.0, LENGTH + 1
    white, steady = K / 2 + EPS / (2 * K), K / 2 + (EPS / K) ** 2
    return {
        ("white", "none"): (
            "ε(t+1)/3 + 1/(t+1) - ε/(3(t+1)²)",
            EPS * t / 3 + 1 / t - EPS / (3 * t**2),
        ),
        ("constant", "none"): (
            "1/(t+1) + (ε²/4)(t+1 - 1/(t+1))²",
            1 / t + (EPS / 2 * (t - 1 / t)) ** 2,
        ),
        ("white", "noise"): ("K/2 + ε/(2K), K = √q", white),
        ("constant", "noise"): ("K/2 + (ε/K)², K = √q", steady),
        ("white", "weighting"): ("K/2 + ε/(2K), K = 2 alpha", white),
        ("constant", "weighting"): ("K/2 + (ε/K)², K = 2 alpha", steady),
        ("white", "memory"): ("1/M + εM/3", 1 / M + EPS * M / 3),
        ("constant", "memory"): ("1/M + (εM/2)²", 1 / M + (EPS * M / 2) ** 2),
    }


def run(experiment: Experiment) -> None:
    """Simulates every remedy under both pushes and compares with the exact curves."""
    quick = experiment.options.quick
    runs, dt = experiment.size(4000, 200), 0.1 if quick else 0.02
    time = np.arange(1, round(LENGTH / dt) + 1) * dt
    cases = list(product(PUSHES, REMEDIES))
    filters = {r: divergence_filter(r, dt=dt, setting=chosen_setting(r, dt)) for r in REMEDIES}

    found: dict[tuple[Push, Remedy], Arrays] = {}
    for number, push in enumerate(PUSHES):
        world = divergence(push, eps=EPS, dt=dt, length=LENGTH)
        compared = experiment.compare(
            f"{push} push", filters, world, runs=runs, key=experiment.key(number), time=True
        )
        (steps,) = compared.over_time["squared_error"]
        errors = zip(steps.mean, standard_error(steps), strict=True)
        for remedy, (mse, mse_se) in zip(REMEDIES, errors, strict=True):
            found[push, remedy] = {"mse": mse, "mse_se": mse_se}
    exact = {
        (push, remedy): np.asarray(
            divergence_curve(remedy, push, time, eps=EPS, setting=chosen_setting(remedy, dt))
        )
        for push, remedy in cases
    }
    final = {
        (push, remedy): np.asarray(
            [
                divergence_curve(
                    remedy, push, [LENGTH], eps=EPS, setting=setting_for(remedy, gain)
                )[0]
                for gain in GAINS
            ]
        )
        for push, remedy in cases
        if remedy != "none"
    }
    experiment.arrays("divergence", _divergence_arrays(time, found, exact, final))
    experiment.figure("divergence", figures.growth_curves(time, found, exact, TEXT))
    experiment.figure("settings", figures.setting_curves(GAINS, final, exact, np.sqrt(EPS), TEXT))
    forms = closed_forms(dt)
    rows = [_claim_row(case, found[case], exact[case], forms[case], dt) for case in cases]
    printed = 1 / (LENGTH + 1) + EPS * (LENGTH + 1) / 2
    unremedied = rows[cases.index(("constant", "none"))]["simulated"]
    off = (unremedied.value - printed) / unremedied.error
    experiment.table(
        "divergence",
        f"A constant that is pushed: {runs} runs of {LENGTH:g} s, ε = {EPS:g}",
        rows,
        [
            f"Mean square error at the end; the simulated filters are sampled every {dt:g} s,",
            "exact is the continuous filter's, halfway the same at half the time, and the formula",
            "is that of the settled filter (at the end without a remedy). The settings are those",
            "with the least final error under the white push.",
            "Without a remedy and with a constant push the paper prints 1/(t+1) + ε(t+1)/2 =",
            f"{printed:.4g}: the simulation is {off:.0f} standard errors above it.",
        ],
    )
    experiment.finish()


def _claim_row(
    case: tuple[Push, Remedy], one: Arrays, exact: np.ndarray, form: tuple[str, float], dt: float
) -> dict[str, Any]:
    push, remedy = case
    setting = chosen_setting(remedy, dt)
    return {
        "push": push,
        "remedy": TEXT[remedy],
        "setting": "" if setting is None else f"{setting:.4g} {UNITS[remedy]}",
        "simulated": Measured(float(one["mse"][-1]), float(one["mse_se"][-1])),
        "exact": float(exact[-1]),
        "halfway": float(exact[exact.size // 2 - 1]),
        "formula": form[0],
        "its value": form[1],
    }


def _divergence_arrays(
    time: np.ndarray, found: PyTree, exact: Numbers, final: Numbers
) -> xr.Dataset:
    def stacked(x: Numbers, names: tuple[str, ...], last: str) -> xr.DataArray:
        table = np.stack([[x[push, name] for name in names] for push in PUSHES])
        return xr.DataArray(
            table,
            dims=("push", "remedy", last),
            attrs={"units": "1"},
            coords={"push": list(PUSHES), "remedy": list(names)},
        )

    simulated = {
        name: stacked({k: v[name] for k, v in found.items()}, REMEDIES, "time")
        for name in ("mse", "mse_se")
    }
    return xr.Dataset(
        {
            **simulated,
            "mse_exact": stacked(exact, REMEDIES, "time"),
            "final_mse_by_gain": stacked(final, REMEDIES[1:], "gain").rename(remedy="set_remedy"),
        }
    ).assign_coords(time=("time", time, {"units": "s"}), gain=("gain", GAINS, {"units": "1/s"}))
