"""Interacting multiple models of linear filters, as printed by Blom & Bar-Shalom (1988)."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray


class Modes(NamedTuple):
    """mean and cov of the mixture, mu (M,), innovation and innovation_cov of the mixture, and its
    log density."""

    mean: Array
    cov: Array
    mu: Array
    innovation: Array
    innovation_cov: Array
    log_density: float


def mixture(weights: Array, means: Array, covs: Array) -> tuple[Array, Array]:
    """Moments of a mixture of Gaussians."""
    mean = weights @ means
    apart = means - mean
    spread = covs + apart[:, :, None] * apart[:, None, :]
    cov = np.tensordot(weights, spread, 1)
    return mean, cov


def filtered(
    models: Sequence[dict[str, Any]], chances: Any, mu: Array, prior: Any, t0: float, stream: Any
) -> list[Modes]:
    """After each row (time, value, sensor, mask) in sequence; a model has F, Q, b(t0, t1), H and R
    (S, ...); chances(t0, t1) is (M, M)."""
    count, now, found = len(models), t0, []
    x = np.stack([np.asarray(prior[0])] * count)
    P = np.stack([np.asarray(prior[1])] * count)
    for time, value, sensor, mask in stream:
        if time > now:
            Pi = chances(now, time)
            ahead = mu @ Pi
            mixed = [mixture(Pi[:, j] * mu / ahead[j], x, P) for j in range(count)]
            for j, (model, (m, C)) in enumerate(zip(models, mixed, strict=True)):
                F = model["F"](now, time)
                x[j] = F @ m + model["b"](now, time)
                P[j] = F @ C @ F.T + model["Q"](now, time)
            mu, now = ahead, time
        told, nus, Ss = np.zeros(count), [], []
        for j, model in enumerate(models):
            H, R = model["H"][sensor][mask], model["R"][sensor][np.ix_(mask, mask)]
            nu, S = value[mask] - H @ x[j], H @ P[j] @ H.T + R
            K = P[j] @ H.T @ np.linalg.inv(S)
            x[j], P[j] = x[j] + K @ nu, P[j] - K @ S @ K.T
            told[j] = -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1])
            nus.append(nu)
            Ss.append(S)
        seen = mixture(mu, np.array(nus), np.array(Ss))
        joint = mu * np.exp(told)
        mu = joint / joint.sum()
        found.append(Modes(*mixture(mu, x, P), mu, *seen, float(np.log(joint.sum()))))
    return found
