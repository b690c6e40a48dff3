"""Limited-memory estimate: unweighted least squares of the last seconds only, in batch form."""

from .dense import Array, Between, Floats, Stack
from .wls import batch_wls


def limited_memory(
    t: float,
    window: float,
    A: Between,
    offset: Between | None,
    times: Floats,
    H: Stack,
    R: Stack,
    values: Stack,
    masks: Stack | None = None,
) -> tuple[Array, Array]:
    """Return the estimate (8), (9) of Shulami & Sigalov, W = 1, from t - window <= t_l <= t."""
    kept = [k for k, t_l in enumerate(times) if t - window <= t_l <= t]
    return batch_wls(
        t,
        A,
        offset,
        [times[k] for k in kept],
        [H[k] for k in kept],
        [R[k] for k in kept],
        [values[k] for k in kept],
        weight=lambda t_l, t_k: 1.0,
        masks=None if masks is None else [masks[k] for k in kept],
    )
