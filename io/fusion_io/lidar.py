"""Depth from the scans of a LiDAR: its points, projected into the image. Nothing is filled in between them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from fusion_io.errors import LogError
from fusion_io.images import Framing, read_image
from fusion_io.records import CameraFrame, CameraInfo, FloatArray

#: Of the files that hold a scan.
SUFFIX = ".bin"

#: A point of KITTI's files: x, y, z in metres and the reflectance, little endian.
_POINT = np.dtype("<f4").itemsize * 4


@dataclass(frozen=True, slots=True)
class LidarRig:
    """A rectified camera with its K (3, 3) in pixels, and where the LiDAR is: T_camera_lidar."""

    K: FloatArray
    T_camera_lidar: RigidTransform


@dataclass(frozen=True, slots=True)
class Scan:
    """The files of one frame; points is None where there is no scan."""

    stamp_ns: int
    image: Path
    points: Path | None


def read_points(path: Path) -> FloatArray | None:
    """The points (N, 3) of a scan of KITTI, metres in the LiDAR's frame; those that are not finite are left out.

    None where the file cannot be read or is not a whole number of points.
    """
    try:
        data = path.read_bytes()
    except OSError:
        return None
    if not data or len(data) % _POINT:
        return None
    points = np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def project(points: FloatArray, camera: CameraInfo) -> NDArray[np.float32]:
    """The depth image (H, W) in metres that points (N, 3) in the camera's frame make, 0 where there is none.

    A point belongs to the pixel whose centre is nearest. Of several the nearest wins: the others are likely to be
    hidden by it, as the LiDAR sees past edges that the camera, from its other place, does not. Points behind the
    camera or outside of the image are left out.
    """
    points = points[points[:, 2] > 0]
    homogeneous = points @ camera.K.T
    u, v = np.rint(homogeneous[:, :2] / homogeneous[:, 2:]).T
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    pixels = (v[inside] * camera.width + u[inside]).astype(np.int64)
    depth = np.full(camera.height * camera.width, np.inf, dtype=np.float32)
    np.minimum.at(depth, pixels, points[inside, 2].astype(np.float32))
    depth[np.isinf(depth)] = 0
    return depth.reshape(camera.height, camera.width)


def lidar_frames(
    rig: LidarRig,
    scans: Sequence[Scan],
    framing: Framing,
    warnings: Counter[str],
    size: tuple[int, int] | None = None,
) -> Iterator[CameraFrame]:
    """Frames of the camera with the depth of its LiDAR's points, in the order of ``scans``.

    Points are projected into the image as it is framed, so that a smaller image is a denser one. A frame whose
    image cannot be decoded is left out, one without a scan has no depth; both are counted. size: (width, height)
    that the camera is calibrated for, by default that of the first image; an image of another size is a
    ``LogError``.
    """
    for scan in scans:
        image = read_image(scan.image)
        if image is None:
            warnings["frames skipped (left image cannot be decoded)"] += 1
            continue
        height, width = image.shape[:2]
        size = (width, height) if size is None else size
        if (width, height) != size:
            raise LogError(f"{scan.image}: {width}x{height} pixels where {size[0]}x{size[1]} are expected")
        points = None if scan.points is None else read_points(scan.points)
        if points is None and scan.points is not None:
            warnings["frames without depth (scan cannot be read)"] += 1
        camera = framing.camera(CameraInfo(width, height, rig.K))
        depth = None if points is None else project(rig.T_camera_lidar.apply(points), camera)
        yield CameraFrame(scan.stamp_ns, framing.image(image), depth, camera)
