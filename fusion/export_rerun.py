"""A log as a native rerun recording: images, trajectories, frustums, covariance ellipsoids and plots on one timeline.

Entities: ``world/NAME/path`` and ``world/NAME/camera`` for each trajectory, ``world/NAME/sigma`` for three standard
deviations of its position; ``world/NAME/camera/image`` under the one that carries the images; ``plots/...``.
https://rerun.io/docs/concepts/entity-component.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation

from fusion.evaluation import common, errors_over_time
from fusion_io.reader import Log
from fusion_io.records import CameraFrame, FloatArray, IntArray, PairEstimate, Trajectory

TIMELINE = "time"
SIGMAS = 3.0
JPEG_QUALITY = 85
FRUSTUM_M = 2.0

# Okabe and Ito's palette, which the colour-blind can tell apart: https://jfly.uni-koeln.de/color/.
COLOURS = {
    "ground_truth": (0, 158, 115),
    "raw": (140, 140, 140),
    "posegraph": (0, 114, 178),
    "posegraph_online": (86, 180, 233),
    "ekf": (213, 94, 0),
    "ekf_smoothed": (230, 159, 0),
}
OTHER_COLOUR = (204, 121, 167)
LOOP_COLOUR = (240, 228, 66)

# The trajectory that carries the images: the first of these that there is.
PREFERRED = ("posegraph", "ekf", "raw")


def write_rerun(path: Path, log: Log, images: Log) -> None:
    """Write the recording of a log, with the images of another or the same, if that has any.

    Times are the stamps of the log. The ground truth is shown from the first pose that it has in common with the
    trajectories, as the errors are computed. Raises LogError for images that cannot be used.
    """
    trajectories = {name: each for name in log.trajectory_names if (each := log.trajectory(name)) is not None}
    recording = rr.RecordingStream("violearner-fusion", recording_id=log.sha256)
    carrier = next((name for name in (*PREFERRED, *trajectories) if name in trajectories), None)
    shown = f"world/{carrier}/camera/image" if carrier else "camera/image"
    recording.save(path, default_blueprint=_blueprint(shown if images.has_frames else None))
    recording.log("world", rr.ViewCoordinates.RDF, static=True)
    truth = log.ground_truth()
    if truth is not None:
        _log_trajectory(recording, "ground_truth", _in_world_of(trajectories, truth), COLOURS["ground_truth"])
    for name, each in trajectories.items():
        _log_trajectory(recording, name, each, COLOURS.get(name, OTHER_COLOUR))
        _log_estimates(recording, log, name, each, truth)
    _log_sensors(recording, log)
    if carrier is not None:
        _log_loops(recording, log.loops(), trajectories[carrier])
    if images.has_frames:
        _log_frames(recording, shown, images)
    recording.flush()
    recording.disconnect()


def ellipsoids(trajectory: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Half axes (N, 3) in m of SIGMAS standard deviations of position, and their directions quats_xyzw (N, 4).

    Directions are those in the world. The covariance of a pose speaks of the position in camera axes.
    """
    assert trajectory.covariances is not None
    variances, axes = np.linalg.eigh(trajectory.covariances[:, 3:, 3:])
    axes[np.linalg.det(axes) < 0, :, 0] *= -1  # a rotation, not a reflection
    directions = trajectory.poses.rotation * Rotation.from_matrix(axes)
    return SIGMAS * np.sqrt(np.maximum(variances, 0.0)), directions.as_quat()


def _in_world_of(trajectories: dict[str, Trajectory], truth: Trajectory) -> Trajectory:
    """The ground truth with its first compared pose on that of the trajectories."""
    for each in trajectories.values():
        compared, same = common(each, truth)
        if len(compared):
            first = each.poses[int(np.searchsorted(each.stamps_ns, compared.stamps_ns[0]))]
            return Trajectory(same.stamps_ns, first * same.poses)
    return truth.relative_to_first()


def _log_trajectory(recording: rr.RecordingStream, name: str, trajectory: Trajectory, colour: Sequence[int]) -> None:
    positions, times = trajectory.poses.translation, [_times(trajectory.stamps_ns)]
    recording.log(f"world/{name}/path", rr.LineStrips3D([positions], colors=[colour], labels=[name]), static=True)
    recording.send_columns(
        f"world/{name}/camera",
        times,
        rr.Transform3D.columns(translation=positions, quaternion=trajectory.poses.rotation.as_quat()),
    )
    if trajectory.covariances is not None:
        half_sizes, quats_xyzw = ellipsoids(trajectory)
        recording.send_columns(
            f"world/{name}/sigma",
            times,
            rr.Ellipsoids3D.columns(half_sizes=half_sizes, centers=positions, quaternions=quats_xyzw),
        )
        recording.log(f"world/{name}/sigma", rr.Ellipsoids3D.from_fields(colors=[colour]), static=True)


def _log_estimates(
    recording: rr.RecordingStream, log: Log, name: str, trajectory: Trajectory, truth: Trajectory | None
) -> None:
    """Errors with the stated 3-sigma, and what the back end estimated beside the poses."""
    if truth is not None:
        errors = errors_over_time(trajectory, truth)
        _plot(recording, f"plots/position_error_m/{name}", errors.stamps_ns, _norms(errors.position_error_m), [name])
        rotation = _norms(errors.rotation_error_rad)
        _plot(recording, f"plots/rotation_error_rad/{name}", errors.stamps_ns, rotation, [name])
    if trajectory.covariances is not None:
        sigma = SIGMAS * np.sqrt(np.trace(trajectory.covariances[:, 3:, 3:], axis1=1, axis2=2))
        _plot(recording, f"plots/position_error_m/{name}_3sigma", trajectory.stamps_ns, sigma, [f"{name} 3 sigma"])
    if (series := log.estimator(name)) is None:
        return
    for quantity in ("gyro_bias", "accelerometer_bias", "rate_bias"):
        labels = [f"{name} {axis}" for axis in "xyz"]
        _plot(recording, f"plots/{quantity}/{name}", series.stamps_ns, getattr(series, quantity), labels)
    for quantity in ("scale_error", "nis"):
        _plot(recording, f"plots/{quantity}/{name}", series.stamps_ns, getattr(series, quantity), [name])


def _log_sensors(recording: rr.RecordingStream, log: Log) -> None:
    imu = log.imu()
    if len(imu):
        _plot(recording, "plots/imu/angular_velocity_rad_s", imu.stamps_ns, imu.angular_velocity, list("xyz"))
        _plot(recording, "plots/imu/linear_acceleration_m_s2", imu.stamps_ns, imu.linear_acceleration, list("xyz"))


def _log_loops(recording: rr.RecordingStream, loops: Sequence[PairEstimate], trajectory: Trajectory) -> None:
    """A line for each loop closure between two frames of a trajectory."""
    place = {int(stamp): i for i, stamp in enumerate(trajectory.stamps_ns)}
    ends = [(loop.source_stamp_ns, loop.target_stamp_ns) for loop in loops]
    positions = trajectory.poses.translation
    lines = [positions[[place[a], place[b]]] for a, b in ends if a in place and b in place]
    if lines:
        recording.log("world/loops", rr.LineStrips3D(lines, colors=[LOOP_COLOUR]), static=True)


def _log_frames(recording: rr.RecordingStream, entity: str, images: Log) -> None:
    """The images as JPEG under the pinhole that draws their frustum."""
    for frame in images.frames():
        recording.set_time(TIMELINE, timestamp=np.datetime64(frame.stamp_ns, "ns"))
        recording.log(
            entity,
            rr.Pinhole(
                image_from_camera=frame.camera.K,
                resolution=[frame.camera.width, frame.camera.height],
                image_plane_distance=FRUSTUM_M,
            ),
            rr.EncodedImage(contents=_jpeg(frame), media_type="image/jpeg"),
        )


def _jpeg(frame: CameraFrame) -> bytes:
    bgr = frame.image if frame.image.ndim == 2 else cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


def _plot(
    recording: rr.RecordingStream, entity: str, stamps_ns: IntArray, values: FloatArray, names: list[str]
) -> None:
    """One line for each column of values (N,) or (N, M)."""
    recording.log(entity, rr.SeriesLines(names=names), static=True)
    columns = rr.Scalars.columns(scalars=values)
    if values.ndim == 2:
        columns = rr.Scalars.columns(scalars=values.ravel()).partition(np.full(len(values), values.shape[1]))
    recording.send_columns(entity, [_times(stamps_ns)], columns)


def _times(stamps_ns: IntArray) -> rr.TimeColumn:
    return rr.TimeColumn(TIMELINE, timestamp=stamps_ns.astype("datetime64[ns]"))


def _norms(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(vectors, axis=1))


def _blueprint(image_entity: str | None) -> rrb.Blueprint:
    """The world with the images below, if there are any, on the left; plots on the right."""
    world = rrb.Spatial3DView(origin="world", name="World")
    quantities = ("position_error_m", "rotation_error_rad", "gyro_bias", "scale_error", "nis", "imu")
    plots = [rrb.TimeSeriesView(origin=f"plots/{each}", name=each.replace("_", " ")) for each in quantities]
    images = [] if image_entity is None else [rrb.Spatial2DView(origin=image_entity, name="Image")]
    left = rrb.Vertical(world, *images, row_shares=[3, 1] if images else [1])
    return rrb.Blueprint(rrb.Horizontal(left, rrb.Vertical(*plots), column_shares=[3, 2]), collapse_panels=True)
