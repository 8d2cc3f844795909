"""Satellite positions: which fixes can be used, where on the earth the world is, and their factors in the pose graph.

Fixes become east-north-up coordinates about an origin on WGS84's ellipsoid, by way of earth-centred ones (pymap3d): no
map projection, so that distances are true. What ties the world to that frame, T_enu_world (U), and where the antenna is
(L) are estimated with the poses. With an IMU gravity points down in it, which leaves one angle to the fixes.

Alignment: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991, without a
scale, with iteratively reweighted least squares for the sum of distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import gtsam
import numpy as np
import pymap3d
from gtsam.symbol_shorthand import E, G, L, U
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.config import GnssConfig
from fusion.factors import Batch, GnssFactors, by_vector, extrinsics, padded, poses_of
from fusion.pair_model import skew
from fusion_io.findings import Findings
from fusion_io.records import LONGEST_INTERPOLATION_S, NANOSECONDS, FloatArray, GnssFix, IntArray, Trajectory
from fusion_io.words import counted

if TYPE_CHECKING:
    from fusion.posegraph import Problem, Solution

MIN_FIXES = 3
FARTHEST_M = 100e3  # of a fix from the median of all: further away up is another direction
SMALLEST_SIGMA_M = 1e-3  # of a covariance; below, it is none
DEFLECTION_RAD = 2e-4  # of the plumb line from the ellipsoid's normal, which rarely is more
LARGEST_ANGLE_SIGMA = 0.3  # rad: an angle that is less certain is not known
WEAK_SIGMAS = np.repeat([1.0, 1e4], 3)  # rad, m: of the first alignment, for what the fixes leave open
REWEIGHTINGS = 20
UP_IN_CAMERA = np.array([0.0, -1.0, 0.0])


class Origin(NamedTuple):
    """The origin of a local east-north-up frame, on WGS84's ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


@dataclass(frozen=True, slots=True)
class Positions:
    """Usable fixes: stamps_ns (N,) strictly increasing, on the camera's clock; enu_m and covariances (N, 3, 3) m^2.

    enu_m (N, 3): of the antenna, about the origin. antenna_m (3,): where it is in camera axes, to antenna_sigma_m.
    """

    stamps_ns: IntArray
    enu_m: FloatArray
    covariances: FloatArray
    origin: Origin
    antenna_m: FloatArray
    antenna_sigma_m: float


@dataclass(frozen=True, slots=True)
class PlacedFixes:
    """Fixes in the world of a trajectory: stamps_ns (N,), places_m (N, 3), and used (N,), which were believed."""

    stamps_ns: IntArray
    places_m: FloatArray
    used: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Georeference:
    """Where on the earth a world is.

    T_enu_world (4, 4), and its covariance (6, 6), rotation first, right perturbation. antenna_m (3,) in camera axes,
    with its covariance. used (N,): which of the fixes taken during the trajectory were believed; residual_rms_m: root
    mean square of their distance to the antenna's estimated positions.
    """

    origin: Origin
    T_enu_world: FloatArray
    covariance: FloatArray
    antenna_m: FloatArray
    antenna_covariance: FloatArray
    used: NDArray[np.bool_]
    residual_rms_m: float

    def of(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory of the camera in the local frame; without covariances, which would need those of both."""
        return Trajectory(trajectory.stamps_ns, RigidTransform.from_matrix(self.T_enu_world) * trajectory.poses)

    def in_world(self, known: Positions, stamps_ns: IntArray) -> PlacedFixes:
        """The positions of the antenna that were measured during a trajectory with these stamps, in its world."""
        during, _, _ = _between(stamps_ns, known.stamps_ns)
        places_m = RigidTransform.from_matrix(self.T_enu_world).inv().apply(known.enu_m[during])
        return PlacedFixes(known.stamps_ns[during], places_m, self.used)


def positions(fixes: Sequence[GnssFix], config: GnssConfig, findings: Findings) -> Positions | None:
    """The fixes that can be used, about the first of them; None where there are none.

    Left out and counted are those without a position on the earth, those that repeat a stamp, and those far from all
    the others, such as zeros that stand for "not known".
    """
    if not (fixes and config.use):
        return None
    stamps_ns = np.array([fix.stamp_ns for fix in fixes], dtype=np.int64)
    geodetic = np.array([(fix.latitude_deg, fix.longitude_deg, fix.altitude_m) for fix in fixes])
    usable = _usable(stamps_ns, geodetic)
    unusable = len(fixes) - len(usable)
    findings.put("gnss_unusable", unusable, f"GNSS fixes without a place, or far from all others: {unusable}")
    if not len(usable):
        return None
    origin = Origin(*geodetic[usable[0]].tolist())
    known = config.antenna is not None
    return Positions(
        stamps_ns[usable] - round(config.time_offset_s * NANOSECONDS),
        np.stack(pymap3d.geodetic2enu(*geodetic[usable].T, *origin), axis=1),
        np.stack([_covariance(fixes[i], config.sigma) for i in usable.tolist()]),
        origin,
        np.array(config.antenna) if known else np.zeros(3),
        config.given_antenna_sigma if known else config.antenna_sigma,
    )


def _usable(stamps_ns: IntArray, geodetic: FloatArray) -> IntArray:
    """The indices of places (N, 3) on the earth that are near to the others, one a stamp and in their order."""
    latitude, longitude, _ = geodetic.T
    on_earth = np.isfinite(geodetic).all(axis=1) & (abs(latitude) <= 90.0) & (abs(longitude) <= 360.0)
    usable = np.flatnonzero(on_earth)
    if len(usable):
        ecef = np.stack(pymap3d.geodetic2ecef(*geodetic[usable].T), axis=1)
        usable = usable[np.linalg.norm(ecef - np.median(ecef, axis=0), axis=1) < FARTHEST_M]
    return np.asarray(usable[np.unique(stamps_ns[usable], return_index=True)[1]])


def _covariance(fix: GnssFix, sigma_m: float) -> FloatArray:
    """That of a fix (3, 3), or the one assumed where it states none that is one."""
    stated = fix.covariance
    assumed = sigma_m**2 * np.eye(3)
    if stated is None or not np.all(np.isfinite(stated)) or not np.allclose(stated, stated.T):
        return assumed
    return stated if np.linalg.eigvalsh(stated)[0] >= SMALLEST_SIGMA_M**2 else assumed


# --------------------------------------------------------------------------------------------------- the alignment


def align(world_m: FloatArray, enu_m: FloatArray, sigma_m: float, up: FloatArray, up_known: bool) -> FloatArray:
    """T_enu_world (4, 4) that brings positions (N, 3) of the world to those of the local frame; for large errors too.

    The sum of distances is minimised, to which an outlier adds no more than how far it is. sigma_m: below it distances
    do not matter. up (3,): the direction in the world; exact where it is known, else what decides where positions on a
    line leave it open.
    """
    weights = np.full(len(world_m), 1.0 / sigma_m)
    of_up = np.inf if up_known else sigma_m / LARGEST_ANGLE_SIGMA**2  # beside weights of 1 / sigma
    for _ in range(REWEIGHTINGS):
        middle_world, middle_enu = (np.average(each, axis=0, weights=weights) for each in (world_m, enu_m))
        rotation = _rotation(world_m - middle_world, enu_m - middle_enu, weights, up, of_up)
        distances = np.linalg.norm(rotation.apply(world_m - middle_world) - (enu_m - middle_enu), axis=1)
        weights = 1.0 / np.maximum(distances, sigma_m)
    T_enu_world = np.eye(4)
    T_enu_world[:3, :3] = rotation.as_matrix()
    T_enu_world[:3, 3] = middle_enu - rotation.apply(middle_world)
    return T_enu_world


def _rotation(world_m: FloatArray, enu_m: FloatArray, weights: FloatArray, up: FloatArray, of_up: float) -> Rotation:
    """The rotation that turns weighted vectors (N, 3) into others, and up into up with a weight of its own."""
    ups = up / np.linalg.norm(up)
    rotation, _ = Rotation.align_vectors(
        np.vstack([[0.0, 0.0, 1.0], enu_m]), np.vstack([ups, world_m]), weights=np.concatenate([[of_up], weights])
    )
    return rotation


def _left_open(world_m: FloatArray, sigma_m: FloatArray, up: FloatArray | None) -> str:
    """Why positions (N, 3) with standard deviations (N,) do not tell the directions of the local frame; empty if so.

    About an axis they tell an angle as exactly as their distances from it are long in terms of sigma_m.
    """
    if len(world_m) < MIN_FIXES:
        return f"{counted(len(world_m), 'fix', 'fixes')} during the trajectory"
    from_middle = world_m - np.average(world_m, axis=0, weights=sigma_m**-2)
    scaled = from_middle / sigma_m[:, None]
    across = scaled if up is None else scaled - np.outer(scaled @ up, up)
    if np.linalg.norm(across) * LARGEST_ANGLE_SIGMA < 1.0:
        moved = np.linalg.norm(from_middle, axis=1).max()
        return f"fixes good to {np.median(sigma_m):.1f} m say too little within {moved:.1f} m"
    return ""


# ------------------------------------------------------------------------------------------------------ the factors


class AntennaFactor(Batch):
    """Where the antenna is thought to be in camera axes (3,), for L(0) in the axes of X and E(0)."""

    def __init__(self, T_camera_imu: FloatArray, antenna_m: FloatArray, sigma_m: float) -> None:
        super().__init__([[L(0), E(0)]], 3, judged=False)
        self._T_camera_imu, self._antenna_m, self._sigma_m = T_camera_imu, antenna_m, sigma_m

    def _evaluate(self, values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        antenna, by_antenna, by_strayed = in_camera(self._T_camera_imu, values.atVector(L(0)), values.atVector(E(0)))
        error = (antenna - self._antenna_m) / self._sigma_m
        return error[None], [by_antenna[None] / self._sigma_m, by_strayed[None] / self._sigma_m]


class UprightFactor(Batch):
    """Gravity G(0) points down in the local frame that U(0) leads to."""

    def __init__(self, sigma_rad: float) -> None:
        super().__init__([[U(0), G(0)]], 2, judged=False)
        self._sigma_rad = sigma_rad

    def _evaluate(self, values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        R_enu_world = values.atPose3(U(0)).rotation().matrix()
        gravity = values.atUnit3(G(0))
        down = gravity.point3()
        by_frame = np.hstack([-R_enu_world @ skew(down), np.zeros((3, 3))])
        by_gravity = R_enu_world @ gravity.basis()
        errors = (R_enu_world @ down)[None, :2]
        return errors / self._sigma_rad, [each[None, :2] / self._sigma_rad for each in (by_frame, by_gravity)]


def in_camera(
    T_camera_imu: FloatArray, antenna_m: FloatArray, strayed: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The antenna (3,) in camera axes, and how it changes with the one in IMU axes (3, 3) and with E(0) (3, 10)."""
    mounted = extrinsics(T_camera_imu, strayed)
    R = mounted[:3, :3]
    by_extrinsics = np.zeros((1, 6, 7))
    by_extrinsics[0, :3, :6] = np.hstack([-R @ skew(antenna_m), R])
    return R @ antenna_m + mounted[:3, 3], R, padded(by_extrinsics @ by_vector(strayed))[0, :3]


@dataclass(frozen=True, slots=True)
class Tie:
    """What ties a problem to the earth: the factors of the fixes, and the origin that they are about."""

    factors: GnssFactors
    origin: Origin

    def georeference(self, problem: Problem, solution: Solution) -> Georeference:
        """What came out of it."""
        values, used = solution.values, self.factors.weights >= 0.5
        antenna, by_antenna = values.atVector(L(0)), np.eye(3)
        if problem.twists is not None:
            antenna, by_own, by_strayed = in_camera(problem.T_camera_imu, antenna, values.atVector(E(0)))
            by_antenna = np.hstack([by_own, by_strayed])
        squares = np.sum(self.factors.residual[used] ** 2, axis=1)
        return Georeference(
            self.origin,
            np.asarray(values.atPose3(U(0)).matrix()),
            solution.covariances[U(0)],
            antenna,
            by_antenna @ solution.covariances[L(0)] @ by_antenna.T,
            used,
            float(np.sqrt(squares.mean())) if np.any(used) else 0.0,
        )


def tie(problem: Problem, known: Positions | None) -> tuple[Tie | None, str]:
    """Add positions to a problem of the pose graph, which then holds U(0) and L(0); or a reason why they say nothing.

    A fix counts that was taken between two poses which are close enough in time to interpolate.
    """
    if known is None:
        return None, ""
    during, before, share = _between(problem.stamps_ns, known.stamps_ns)
    poses = poses_of(problem.values)
    antenna = problem.T_camera_imu[:3, :3].T @ (known.antenna_m - problem.T_camera_imu[:3, 3])
    carried = poses[:, :3, :3] @ antenna + poses[:, :3, 3]
    world_m = (1.0 - share) * carried[before] + share * carried[before + 1]
    sigma_m = np.sqrt(np.trace(known.covariances[during], axis1=1, axis2=2) / 3)
    gravity = problem.values.atUnit3(G(0)).point3() if problem.values.exists(G(0)) else None
    if reason := _left_open(world_m, sigma_m, gravity):
        return None, reason

    up = UP_IN_CAMERA if gravity is None else -gravity
    start = gtsam.Pose3(align(world_m, known.enu_m[during], float(np.median(sigma_m)), up, gravity is not None))
    problem.values.insert(U(0), start)
    problem.values.insert(L(0), antenna)
    problem.graph.add(gtsam.PriorFactorPose3(U(0), start, gtsam.noiseModel.Diagonal.Sigmas(WEAK_SIGMAS)))
    if gravity is None:
        noise = gtsam.noiseModel.Isotropic.Sigma(3, known.antenna_sigma_m)
        problem.graph.add(gtsam.PriorFactorVector(L(0), antenna, noise))
    else:
        problem.add(UprightFactor(DEFLECTION_RAD))
        problem.add(AntennaFactor(problem.T_camera_imu, known.antenna_m, known.antenna_sigma_m))
    factors = GnssFactors(known.enu_m[during], known.covariances[during], before, share[:, 0])
    problem.add(factors)
    return Tie(factors, known.origin), ""


def _between(poses_ns: IntArray, stamps_ns: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Of stamps those (N,) between two poses, the pose before each of them, and the share (N, 1) of the one after."""
    before = np.clip(np.searchsorted(poses_ns, stamps_ns, side="right") - 1, 0, len(poses_ns) - 2)
    period_ns = poses_ns[before + 1] - poses_ns[before]
    share = (stamps_ns - poses_ns[before]) / period_ns
    during = np.flatnonzero((share >= 0) & (share <= 1) & (period_ns <= LONGEST_INTERPOLATION_S * NANOSECONDS))
    return during, before[during], share[during, None]


def note(known: Positions | None, georeference: Georeference | None, without: str) -> str:
    """What became of the fixes, in a few words that follow others."""
    if known is None:
        return ""
    if georeference is None:
        return f"; GNSS left out: {without}"
    used = georeference.used
    unsure = np.sqrt(np.linalg.eigvalsh(georeference.covariance[:3, :3])[-1]) > LARGEST_ANGLE_SIGMA
    roll = " (on a line: its roll is a guess)" if unsure else ""
    return f"; GNSS fixes used: {used.sum()} of {len(used)}{roll}"
