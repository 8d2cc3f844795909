"""Fixes of a satellite receiver that is not there: positions that are known, made as sparse and as wrong as its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pymap3d

from fusion_io.records import NANOSECONDS, FloatArray, GnssFix, IntArray

NO_COVARIANCE = np.zeros((3, 3))


@dataclass(frozen=True, slots=True)
class Receiver:
    """A fix every period_s, with white noise_m (standard deviation per axis), which its covariance states.

    outliers: share of fixes that are outlier_m off in some horizontal direction, as by a reflected signal, without
    their covariances saying so. seed: of the noise.
    """

    period_s: float
    noise_m: float = 1.0
    seed: int = 0
    outliers: float = 0.0
    outlier_m: float = 50.0

    def fixes(self, exact: Sequence[GnssFix]) -> list[GnssFix]:
        """What it makes of exact positions in order of time; what those are uncertain by adds to its own noise."""
        stamps_ns = np.array([fix.stamp_ns for fix in exact], dtype=np.int64)
        chosen = [exact[i] for i in every(stamps_ns, self.period_s).tolist()]
        rng = np.random.default_rng([self.seed, 8])
        errors = self.noise_m * rng.normal(size=(len(chosen), 3))
        angles = rng.uniform(0.0, 2.0 * np.pi, len(chosen))
        wrong = rng.random(len(chosen)) < self.outliers
        errors[:, :2] += (wrong * self.outlier_m)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        return [self._wrong_by(fix, error) for fix, error in zip(chosen, errors, strict=True)]

    def _wrong_by(self, fix: GnssFix, error_m: FloatArray) -> GnssFix:
        """A fix that is off by east, north, up."""
        place = fix.latitude_deg, fix.longitude_deg, fix.altitude_m
        latitude_deg, longitude_deg, altitude_m = (float(each) for each in pymap3d.enu2geodetic(*error_m, *place))
        covariance = self.noise_m**2 * np.eye(3) + (NO_COVARIANCE if fix.covariance is None else fix.covariance)
        return replace(
            fix, latitude_deg=latitude_deg, longitude_deg=longitude_deg, altitude_m=altitude_m, covariance=covariance
        )


def every(stamps_ns: IntArray, period_s: float) -> IntArray:
    """The indices of the first stamps, which increase, at or after each multiple of a period since the first one."""
    periods = (stamps_ns - stamps_ns[:1]) // round(period_s * NANOSECONDS)
    return np.flatnonzero(np.diff(periods, prepend=-1) > 0)


def fixes_at(stamps_ns: IntArray, enu_m: FloatArray, origin: tuple[float, float, float]) -> list[GnssFix]:
    """Exact fixes at positions (N, 3) about an origin on WGS84's ellipsoid: degrees, degrees, metres."""
    geodetic = np.stack(pymap3d.enu2geodetic(*enu_m.T, *origin), axis=1)
    return [GnssFix(stamp_ns, *place) for stamp_ns, place in zip(stamps_ns.tolist(), geodetic.tolist(), strict=True)]
