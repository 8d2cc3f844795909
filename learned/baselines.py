"""The classical estimator that the network is measured against: sparse RGB-D visual odometry.

Corners (Shi and Tomasi, CVPR 1994) are tracked by pyramidal Lucas-Kanade flow (Bouguet 2000) forwards and back
(Kalal, Mikolajczyk, Matas, "Forward-backward error", ICPR 2010), lifted by the depth of the source at the image's own
resolution, and the pose follows from perspective-n-point with RANSAC and a least-squares fit to the inliers. All of it
is OpenCV's.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.records import CameraFrame, CameraInfo, FloatArray

MAX_CORNERS = 2000
CORNER_QUALITY = 0.002
CORNER_DISTANCE_PX = 7

FLOW_WINDOW = (15, 15)
FLOW_LEVELS = 5
FLOW_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
#: A track is refused that does not come back to within this of where it began.
FORWARD_BACKWARD_PX = 0.3

#: Further than this from where the pose puts it, a track is an outlier.
REPROJECTION_PX = 1.0
RANSAC_ITERATIONS = 500
RANSAC_CONFIDENCE = 0.9999
#: Fewer inliers are no estimate: with the six unknowns of a pose, a wrong one fits a few tracks by chance.
MIN_INLIERS = 12
#: Inliers are chosen anew with every better pose.
REFINEMENTS = 3

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Motion:
    """T_source_target (4, 4), and how many tracks agree with it."""

    T_source_target: FloatArray
    inliers: int


def rgbd_odometry(source: CameraFrame, target: CameraFrame) -> Motion | None:
    """The motion between two frames of the same log; the same frames give the same bits.

    source must have depth; that of the target is not used. Images may differ in brightness and contrast. None where
    too few tracks agree on a motion (no texture, no depth, no overlap) or the images are not of one size.
    """
    if source.depth is None or source.image.shape[:2] != target.image.shape[:2]:
        return None
    points, pixels = tracks(source.depth, source.camera, grey(source), grey(target))
    found = resect(points, pixels, target.camera.K, REPROJECTION_PX)
    return None if found is None else Motion(found.T_source_target, int(found.inliers.sum()))


@dataclass(frozen=True, slots=True)
class Resection:
    """T_source_target (4, 4), and which of N points agree with it, (N,)."""

    T_source_target: FloatArray
    inliers: NDArray[np.bool_]


def resect(points: FloatArray, pixels: FloatArray, K: FloatArray, reprojection_px: float) -> Resection | None:
    """The camera from which points (N, 3) m of the source camera's frame are seen at pixels (N, 2).

    K (3, 3): of the camera that sees them; reprojection_px: further off, a point is an outlier. RANSAC, then least
    squares over the inliers. None where fewer than `MIN_INLIERS` agree.
    """
    if len(points) < MIN_INLIERS:
        return None
    # OpenCV's RANSAC starts from the same random state at every call.
    found, rotvec, translation, inliers = cv2.solvePnPRansac(
        points,
        pixels,
        K,
        None,
        iterationsCount=RANSAC_ITERATIONS,
        reprojectionError=reprojection_px,
        confidence=RANSAC_CONFIDENCE,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found:
        return None
    chosen = np.zeros(len(points), dtype=np.bool_)
    chosen[inliers.ravel()] = True
    for _ in range(REFINEMENTS):
        rotvec, translation = cv2.solvePnPRefineLM(points[chosen], pixels[chosen], K, None, rotvec, translation)
        projected = cv2.projectPoints(points, rotvec, translation, K, None)[0].reshape(-1, 2)
        chosen = np.linalg.norm(projected - pixels, axis=1) < reprojection_px
        if chosen.sum() < MIN_INLIERS:
            return None
    T_target_source = RigidTransform.from_components(translation.ravel(), Rotation.from_rotvec(rotvec.ravel()))
    return Resection(T_target_source.inv().as_matrix(), chosen)


def grey(frame: CameraFrame) -> NDArray[np.uint8]:
    """The luminance of a frame, (H, W)."""
    image = frame.image
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def tracks(
    depth: Float32, camera: CameraInfo, source: NDArray[np.uint8], target: NDArray[np.uint8]
) -> tuple[FloatArray, FloatArray]:
    """Corners of the source that are found in the target.

    depth (H, W) m, 0 where there is none, and camera are the source's; images (H, W). Returns points (N, 3) in the
    source camera's frame, and pixels (N, 2) of the target.
    """
    known = np.isfinite(depth) & (depth > 0)
    corners = cv2.goodFeaturesToTrack(
        source, MAX_CORNERS, CORNER_QUALITY, CORNER_DISTANCE_PX, mask=known.astype(np.uint8)
    )
    if corners is None:
        return np.zeros((0, 3)), np.zeros((0, 2))
    target = same_exposure(target, source)
    found, forward = flow(source, target, corners)
    returned, back = flow(target, source, found)
    good = forward & back & (np.linalg.norm(returned - corners, axis=2).ravel() < FORWARD_BACKWARD_PX)
    pixels = corners[good].reshape(-1, 2).astype(np.float64)
    u, v = pixels.astype(int).T  # corners are at whole pixels
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.K).T
    return rays * depth[v, u, None].astype(np.float64), found[good].reshape(-1, 2).astype(np.float64)


def same_exposure(image: NDArray[np.uint8], reference: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image with the mean and the standard deviation of the reference: optical flow assumes equal brightness."""
    gain = reference.std() / max(float(image.std()), 1.0)
    return np.asarray(cv2.convertScaleAbs(image, alpha=gain, beta=reference.mean() - gain * image.mean()), np.uint8)


def flow(source: NDArray[np.uint8], target: NDArray[np.uint8], points: Float32) -> tuple[Float32, NDArray[np.bool_]]:
    """Where points (N, 1, 2) of the source are in the target, and which of them were found (N,)."""
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source, target, points, None, winSize=FLOW_WINDOW, maxLevel=FLOW_LEVELS, criteria=FLOW_STOP
    )
    return found, status.ravel().astype(np.bool_)
