"""Latitude and longitude as metres on a local plane, and back."""

from typing import Any

import numpy as np
import pyproj

from ewif_jax import checks


def to_plane(degrees: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Metres east and north (N, 2) of `origin` (latitude, longitude), of latitudes and longitudes
    (N, 2): azimuthal equidistant on WGS84, so distances and bearings from the origin are true, at
    the poles and across the antimeridian too. NaN stays NaN."""
    degrees = np.asarray(degrees, float)
    is_there = np.isfinite(degrees).all(1)
    found = np.full(degrees.shape, np.nan)
    east, north = _tangent_plane(origin)(degrees[is_there, 1], degrees[is_there, 0])
    found[is_there] = np.column_stack([east, north])
    return found


def to_degrees(metres: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Latitudes and longitudes (N, 2) of metres east and north (N, 2) of `origin`."""
    metres = np.asarray(metres, float)
    longitude, latitude = _tangent_plane(origin)(metres[:, 0], metres[:, 1], inverse=True)
    return np.column_stack([latitude, longitude])


def _tangent_plane(origin: np.ndarray) -> Any:
    latitude, longitude = (float(x) for x in origin)
    checks.require(abs(latitude) <= 90, "origin", "a latitude from -90 to 90", latitude)
    return pyproj.Proj(proj="aeqd", lat_0=latitude, lon_0=longitude, ellps="WGS84")
