"""What ensemble filters for late measurements give with infinitely many members, linear models.

A member is mean + C xi with independent standard normal xi, of which every draw adds some. All the
filters do to a member is linear, so means and C say everything; gains come from C C'.
"""

import numpy as np
from numpy.typing import ArrayLike

from .dense import Array, Between, Floats, Stack, interval, matrix, psd_factor, vector, visible


class Member:
    """mean (n,) and C (n, number of draws so far)."""

    def __init__(self, mean: Array, C: Array):
        self.mean, self.C = mean, C

    def widened(self, size: int) -> Array:
        """Return C with zeros for the draws made since."""
        return np.pad(self.C, ((0, 0), (0, size - self.C.shape[1])))

    def moved(self, f: Array, known: Array, root: Array, size: int) -> "Member":
        """Return f x + known + root (the draws that end at number `size`)."""
        C = f @ self.widened(size)
        C[:, size - root.shape[1] :] += root
        return Member(f @ self.mean + known, C)


def enkf_limit(
    *,
    t0: float,
    prior_mean: ArrayLike,
    prior_cov: ArrayLike,
    F: Between,
    Q: Between,
    times: Floats,
    H: Stack,
    R: Stack,
    values: Stack,
    b: Between | None = None,
    masks: Stack | None = None,
    lag: int,
    back: str | None = None,
) -> tuple[Array, Array]:
    """Return means and covariances of the ensemble after each arrival, at the newest time so far.

    `back` None: eqs. (23)-(32), EnKF1, each member with its own innovation. "fresh" or "shared":
    with the step back (47)-(51), minus sign, process noise drawn anew or the one already met.
    """
    n, size = vector(prior_mean).size, vector(prior_mean).size
    now, now_time, used = Member(vector(prior_mean), psd_factor(prior_cov)), t0, False
    past = [(t0, now, now)] * lag  # newest first: time, as it was left, its forecast of now
    means, covs = [], []
    for t, (h, r, z, seen) in zip(times, visible(H, R, values, masks), strict=True):
        if t > now_time and seen.any():
            f, q, known = interval(now_time, t, n, F, Q, b)
            size, root = size + n, psd_factor(q)
            left, now = now, now.moved(f, known, root, size)
            past = [(s, x, ahead.moved(f, known, root, size)) for s, x, ahead in past]
            if used:
                past = [(now_time, left, now), *past[:-1]]
            now_time, used = t, False
        older = [k for k, (s, _, _) in enumerate(past) if s <= t]
        if older and seen.any():
            k = older[0]
            start, before, ahead_before = past[k]
            end, after, ahead_after = past[k - 1] if k else (now_time, now, now)
            share = (t - start) / (end - start) if end > start else 1.0
            there = _between(before, after, share, size)
            if t < now_time and back is not None:
                if back == "fresh":
                    f, q, known = interval(t, now_time, n, F, Q, b)
                    size += n
                    ahead = there.moved(f, known, psd_factor(q), size)
                else:
                    ahead = _between(ahead_before, ahead_after, share, size)
                there = _without(there, now, ahead, size)
            size += r.shape[0]
            S_root = h @ there.widened(size)
            S_root[:, size - r.shape[0] :] += psd_factor(r)
            C = now.widened(size)
            K = C @ S_root.T @ np.linalg.inv(S_root @ S_root.T)
            now, used = Member(now.mean + K @ (z - h @ there.mean), C - K @ S_root), True
        means.append(now.mean)
        covs.append(now.C @ now.C.T)
    return np.array(means), np.array(covs)


def _between(a: Member, b: Member, share: float, size: int) -> Member:
    C = (1.0 - share) * a.widened(size) + share * b.widened(size)
    return Member((1.0 - share) * a.mean + share * b.mean, C)


def _without(x: Member, now: Member, ahead: Member, size: int) -> Member:
    """Return x less its regression on now - ahead."""
    C, D = x.widened(size), now.widened(size) - ahead.widened(size)
    scale = np.square(now.widened(size)).sum()
    gain = C @ D.T @ np.linalg.pinv(D @ D.T, rcond=1e-9, hermitian=True)
    if np.square(D).sum() < 1e-20 * scale:
        return x
    return Member(x.mean - gain @ (now.mean - ahead.mean), C - gain @ D)


def enkf_members(
    members: ArrayLike, there: ArrayLike, h: ArrayLike, r: ArrayLike, value: ArrayLike
) -> tuple[Array, Array]:
    """Return gain and mean innovation of finite ensembles (N, n), eqs. (28)-(31) with R exact."""
    x, seen = matrix(members), matrix(there) @ matrix(h).T
    dx, dz = x - x.mean(0), seen - seen.mean(0)
    pzz = sum(np.outer(e, e) for e in dz) / (len(x) - 1) + matrix(r)
    pxz = sum(np.outer(a, e) for a, e in zip(dx, dz, strict=True)) / (len(x) - 1)
    return pxz @ np.linalg.inv(pzz), vector(value) - seen.mean(0)
