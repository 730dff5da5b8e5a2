"""Numbers over time, from keyframes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicHermiteSpline


class Track:
    """Values [D] between keyframes; the first's before them, the last's after.

    keys:   (time in s, value) in order of time, one or more
    smooth: a cubic Hermite spline with the slopes of Catmull and Rom (1974), at rest at both ends; else
            straight lines
    within: the slopes are limited so that no value leaves the range of the two keyframes around it (Fritsch
            and Carlson 1980)
    """

    def __init__(
        self, keys: Sequence[tuple[float, Sequence[float]]], smooth: bool = True, within: bool = False
    ) -> None:
        self._times = np.array([time for time, _ in keys], np.float64)
        self._values = np.array([value for _, value in keys], np.float64)
        self.moving = bool((self._values != self._values[0]).any())
        self._spline: CubicHermiteSpline | None = None
        if not smooth or len(keys) < 2:
            return
        slopes = np.zeros_like(self._values)
        span = self._times[2:] - self._times[:-2]
        slopes[1:-1] = (self._values[2:] - self._values[:-2]) / span[:, None]
        if within:
            chords = np.diff(self._values, axis=0) / np.diff(self._times)[:, None]
            before, after = chords[:-1], chords[1:]
            most = 3.0 * np.minimum(np.abs(before), np.abs(after)) * (before * after > 0.0)
            slopes[1:-1] = np.clip(slopes[1:-1], -most, most)
        self._spline = CubicHermiteSpline(self._times, self._values, slopes)

    def at(self, time: float) -> np.ndarray:
        """[D] at a time in s."""
        time = float(np.clip(time, self._times[0], self._times[-1]))
        if self._spline is not None:
            value: np.ndarray = self._spline(time)
            return value
        columns = self._values.T
        return np.array([np.interp(time, self._times, column) for column in columns])


__all__ = ["Track"]
