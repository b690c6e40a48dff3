"""Means, errors and paired differences of all methods, from chunks of runs, in flat memory."""

from typing import NamedTuple

import numpy as np


class PairedMoments(NamedTuple):
    """Of M methods on the same runs, (M, M) each, over the runs in which both have a score: how
    many, the mean of the first, the sum of squares of the first about its mean, and of products of
    the two about theirs."""

    count: np.ndarray
    mean: np.ndarray
    squares: np.ndarray
    products: np.ndarray


def paired_moments(scores: np.ndarray) -> PairedMoments:
    """Of scores (M, R), NaN where there is none."""
    scores = scores.astype(float)
    there = ~np.isnan(scores)
    both = there[:, None] & there[None]
    count = both.sum(-1)
    filled = np.where(there, scores, 0.0)
    with np.errstate(invalid="ignore", over="ignore"):
        mean = np.where(both, filled[:, None], 0.0).sum(-1) / np.maximum(count, 1)
        apart = np.where(both, filled[:, None] - mean[..., None], 0.0)
        squares = (apart**2).sum(-1)
        products = (apart * np.swapaxes(apart, 0, 1)).sum(-1)
    return PairedMoments(count, mean, squares, products)


def combined_pairs(some: PairedMoments, others: PairedMoments) -> PairedMoments:
    """Of both sets of runs (Chan, Golub and LeVeque 1979)."""
    count = some.count + others.count
    safe = np.maximum(count, 1)
    with np.errstate(invalid="ignore", over="ignore"):
        apart = others.mean - some.mean
        weight = some.count * others.count / safe
        between = np.where(weight > 0, apart**2 * weight, 0.0)
        crossed = np.where(weight > 0, apart * apart.T * weight, 0.0)
        mean = (some.count * some.mean + others.count * others.mean) / safe
        squares = some.squares + others.squares + between
        products = some.products + others.products + crossed
    return PairedMoments(count, mean, squares, products)


def means(found: PairedMoments, root: bool) -> tuple[np.ndarray, np.ndarray]:
    """(M,) means and standard errors; of the root of the mean (an RMSE) by the delta method."""
    count, mean, squares = (np.diag(x).astype(float) for x in found[:3])
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        error = np.sqrt(squares / (count * (count - 1)))
        mean = np.where(count > 0, mean, np.nan)
        error = np.where(np.isfinite(mean) & (count > 1), error, np.nan)
        if root:
            value = np.sqrt(mean)
            return value, np.where(value > 0, error / (2 * value), error)
    return mean, error


def differences(found: PairedMoments, reference: int, root: bool) -> tuple[np.ndarray, np.ndarray]:
    """(M,) of each method minus the reference, over the runs in which both have a score, with the
    standard errors of their joint scatter."""
    own, other = found.mean[:, reference], found.mean[reference]
    count = found.count[:, reference].astype(float)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        if root:
            own, other = np.sqrt(own), np.sqrt(other)
            slopes = 1 / (2 * own), 1 / (2 * other)
        else:
            slopes = np.ones_like(own), np.ones_like(own)
        spread = (
            slopes[0] ** 2 * found.squares[:, reference]
            + slopes[1] ** 2 * found.squares[reference]
            - 2 * slopes[0] * slopes[1] * found.products[:, reference]
        )
        error = np.sqrt(np.maximum(spread, 0) / (count * (count - 1)))
        value = np.where(count > 0, own - other, np.nan)
    return value, np.where(np.isfinite(value) & (count > 1), error, np.nan)
