"""Writing of observations, ground truth and results to an MCAP file of ROS 2 messages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.ros import names
from sceneslam.ros.encode import sensor_frames
from sceneslam.ros.encode_results import ResultEncoder
from sceneslam.ros.pixels import image_options
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.run import RunResult
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth, placed_by_pose

_CHUNK_BYTES = 256 * 1024  # largest loss if the file is cut off
_DEPTH_UNITS_PER_M = 1000.0


class ObservationWriter:
    """Records observations so that `sources.rosbag` reads the same ones.

    Colour is stored as JPEG or PNG, depth as 16-bit PNG in mm, other values exactly (angles,
    ranges and times of a LaserScan are float32). The file opens in Foxglove.
    """

    def __init__(self, path: Path, *, rig: Rig, image_format: str, jpeg_quality: int = 95) -> None:
        from mcap.writer import CompressionType, Writer

        self._rig = rig
        self._image_format = image_format
        self._image_options = image_options(image_format, jpeg_quality)
        self._encoder = ResultEncoder()
        self._posed: tuple[int, Transform] | None = None
        self._first_pose: tuple[int, Transform] | None = None
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._last_ns = 0
        self._is_open, self._has_frames = True, False
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
        except OSError as err:
            raise InputError(f"recording cannot be written ({err.strerror}): {path}") from err
        self._mcap: Any = Writer(
            self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.NONE
        )
        self._mcap.start(profile="ros2", library="sceneslam")
        self._mcap.add_metadata(names.RIG_METADATA, _rig_metadata(rig))

    def write(self, observation: Observation) -> None:
        """Add all measurements of the observation."""
        stamp_ns, encoder = observation.stamp_ns, self._encoder
        self._write_frames(stamp_ns)
        for at_ns, measured in _inertial(observation).items():
            self._add(names.IMU, at_ns, encoder.imu(at_ns, measured))
        if observation.T_odom_base is not None:
            data = encoder.odometry(stamp_ns, observation.T_odom_base, names.ODOM)
            self._add(names.ODOMETRY, stamp_ns, data)
        if observation.scan is not None:
            data = encoder.scan(stamp_ns, observation.scan)
            self._add(names.SCAN, stamp_ns, data)
        if observation.points_lidar is not None:
            data = encoder.points(stamp_ns, observation.points_lidar, observation.point_times_s)
            self._add(names.POINTS, stamp_ns, data)
        if self._rig.camera and (
            observation.image_bgr is not None or observation.depth_m is not None
        ):
            self._add(names.CAMERA_INFO, stamp_ns, encoder.camera_info(stamp_ns, self._rig.camera))
        if observation.depth_m is not None:
            data = encoder.compressed_image(
                stamp_ns, "16UC1; png compressed ", depth_png(observation.depth_m)
            )
            self._add(names.DEPTH, stamp_ns, data)
        if observation.image_bgr is not None:
            self._write_image(stamp_ns, observation.image_bgr)

    def write_pose(self, stamp_ns: int, T_map_base: Transform) -> None:
        """Add a result: T_map_base (4, 4) [m], as Odometry with velocity and as transform."""
        self._write_frames(stamp_ns)
        before, self._posed = self._posed, (stamp_ns, T_map_base)
        self._first_pose = self._first_pose or self._posed
        twist_base = None if before is None else _twist(*before, stamp_ns, T_map_base)
        data = self._encoder.odometry(stamp_ns, T_map_base, names.MAP, twist_base=twist_base)
        self._add(names.RESULT_ODOMETRY, stamp_ns, data)
        data = self._encoder.transforms(stamp_ns, names.MAP, {names.BASE: T_map_base})
        self._add(names.TF, stamp_ns, data)

    def write_result(self, result: RunResult) -> None:
        """Add the final results: the revised path, the grid and the coloured points."""
        trajectory, at_ns = result.trajectory, self._last_ns
        poses = list(trajectory.T_world_base)
        path = self._encoder.path(trajectory.stamps_ns.tolist(), poses, names.MAP)
        self._add(names.RESULT_PATH, at_ns, path)
        if result.map.grid is not None:
            grid = self._encoder.grid(at_ns, result.map.grid, names.MAP)
            self._add(names.RESULT_MAP, at_ns, grid)
        if len(result.map.points.points):
            cloud = self._encoder.cloud(at_ns, result.map.points, np.eye(4), names.MAP)
            self._add(names.RESULT_POINTS, at_ns, cloud)

    def write_module(self, stamp_ns: int, module: str) -> None:
        """Add a result: the module that is active from `stamp_ns` on."""
        self._add(names.RESULT_MODULE, stamp_ns, self._encoder.text(module))

    def write_event(self, stamp_ns: int, text: str) -> None:
        """Add a result: an event."""
        self._add(names.RESULT_EVENTS, stamp_ns, self._encoder.text(text))

    def write_truth(self, truth: GroundTruth) -> None:
        """Add all true poses (float64) and scene changes; at any time before `close`.

        With results, frame `gt` is aligned with `map` at the first pose, if the truth covers it.
        """
        last_ns = self._last_ns
        self._write_truth_frame(truth.trajectory)
        for stamp_ns, T_gt_base in zip(
            truth.trajectory.stamps_ns.tolist(), truth.trajectory.T_world_base, strict=True
        ):
            data = self._encoder.odometry(stamp_ns, T_gt_base, names.GT)
            self._add(names.TRUTH_ODOMETRY, stamp_ns, data)
        for change in truth.scenes:
            self._add(names.TRUTH_SCENE, change.stamp_ns, self._encoder.text(change.scene))
        self._last_ns = last_ns  # the truth may be longer than the run

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        if not self._is_open:
            return
        self._is_open = False
        self._mcap.finish()
        self._file.close()

    def _write_image(self, stamp_ns: int, image_bgr: NDArray[np.uint8]) -> None:
        done, data = cv2.imencode(f".{self._image_format}", image_bgr, self._image_options)
        if not done:
            raise InputError(f"image at {stamp_ns} ns: could not be written: {image_bgr.shape}")
        encoding = f"bgr8; {self._image_format} compressed bgr8"
        message = self._encoder.compressed_image(stamp_ns, encoding, np.asarray(data, np.uint8))
        self._add(names.IMAGE, stamp_ns, message)

    def _write_frames(self, stamp_ns: int) -> None:
        """Add the sensors' poses on the robot, once, at the first stamp."""
        if self._has_frames:
            return
        self._has_frames = True
        frames = sensor_frames(self._rig)
        if frames:
            data = self._encoder.transforms(stamp_ns, names.BASE, frames)
            self._add(names.TF_STATIC, stamp_ns, data)

    def _write_truth_frame(self, trajectory: Trajectory) -> None:
        if self._first_pose is None:
            return
        T_map_gt = placed_by_pose(trajectory, *self._first_pose)
        if T_map_gt is None:
            return
        stamp_ns, _ = self._first_pose
        data = self._encoder.transforms(stamp_ns, names.MAP, {names.GT: T_map_gt})
        self._add(names.TF_STATIC, stamp_ns, data)

    def _add(self, topic: str, stamp_ns: int, data: bytes) -> None:
        if topic not in self._channels:
            msgtype = names.TYPES[topic]
            if msgtype not in self._schemas:
                self._schemas[msgtype] = self._mcap.register_schema(
                    name=msgtype, encoding="ros2msg", data=self._encoder.definition(msgtype)
                )
            self._channels[topic] = self._mcap.register_channel(
                topic=topic, message_encoding="cdr", schema_id=self._schemas[msgtype]
            )
        self._last_ns = max(self._last_ns, stamp_ns)
        self._mcap.add_message(
            channel_id=self._channels[topic], log_time=stamp_ns, publish_time=stamp_ns, data=data
        )


def _twist(
    before_ns: int, T_map_before: Transform, stamp_ns: int, T_map_base: Transform
) -> NDArray[np.float64] | None:
    """Return the velocity (6,) [m/s, rad/s] in base between two poses, None at equal stamps."""
    if stamp_ns <= before_ns:
        return None
    motion = se3.log(se3.inverse(T_map_before) @ T_map_base)
    return np.asarray(motion * (1e9 / (stamp_ns - before_ns)))


def depth_png(depth_m: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return a 16-bit PNG [mm] of a depth image (H, W) [m]; values that do not fit become 0."""
    depth_mm = np.rint(depth_m * np.float32(_DEPTH_UNITS_PER_M))
    fits = (depth_mm > 0) & (depth_mm <= np.iinfo(np.uint16).max)
    done, data = cv2.imencode(".png", np.where(fits, depth_mm, 0).astype(np.uint16))
    if not done:
        raise InputError(f"depth image could not be written: {depth_m.shape}")
    return np.asarray(data, np.uint8)


def _inertial(observation: Observation) -> dict[int, dict[Sensor, NDArray[np.float64]]]:
    """Return gyro and accelerometer samples (3,), by stamp [ns]."""
    found: dict[int, dict[Sensor, NDArray[np.float64]]] = {}
    for sensor in (sensor for sensor in Sensor if sensor.is_sampled and observation.has(sensor)):
        for row in getattr(observation, sensor.field):
            at_ns = observation.stamp_ns + round(float(row[0]) * 1e9)
            found.setdefault(at_ns, {})[sensor] = row[1:]
    return dict(sorted(found.items()))


def _rig_metadata(rig: Rig) -> dict[str, str]:
    """Return the properties of a rig that no ROS message has."""
    said: dict[str, object] = {"sensors": sorted(sensor.value for sensor in rig.sensors)}
    if rig.camera:
        said["depth_range_m"] = list(rig.camera.depth_range_m)
    if rig.lidar:
        said["lidar_range_m"] = list(rig.lidar.range_m)
    return {key: json.dumps(value) for key, value in said.items()}
