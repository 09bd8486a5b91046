"""Encoding of observations as ROS 2 messages, serialised to CDR."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.ros import names
from sceneslam.types import se3
from sceneslam.types.observation import LaserScan
from sceneslam.types.rig import Camera, Rig, Sensor
from sceneslam.types.se3 import Transform

_DATATYPES = {"<u4": 6, "<f4": 7, "<f8": 8}  # of sensor_msgs/PointField


class Encoder:
    """Builds and serialises the message types of `names.TYPES`."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._store = get_typestore(Stores.ROS2_HUMBLE)

    def definition(self, msgtype: str) -> bytes:
        """Return the type's `ros2msg` definition with its dependencies."""
        return self._store.generate_msgdef(msgtype, ros_version=2)[0].encode()

    def camera_info(self, stamp_ns: int, camera: Camera) -> bytes:
        """Return a CameraInfo (plumb_bob, unrectified)."""
        projection = np.zeros((3, 4))
        projection[:, :3] = camera.K
        return self._cdr(
            names.TYPES[names.CAMERA_INFO],
            header=self._header(stamp_ns, names.CAMERA),
            width=camera.size_wh[0],
            height=camera.size_wh[1],
            distortion_model="plumb_bob",
            d=np.array(camera.distortion, dtype=np.float64),
            k=camera.K.ravel(),
            r=np.eye(3).ravel(),
            p=projection.ravel(),
            binning_x=0,
            binning_y=0,
            roi=self._new(
                "sensor_msgs/msg/RegionOfInterest",
                x_offset=0,
                y_offset=0,
                height=0,
                width=0,
                do_rectify=False,
            ),
        )

    def compressed_image(self, stamp_ns: int, encoding: str, data: NDArray[np.uint8]) -> bytes:
        """Return a CompressedImage of bytes (N,); `encoding` is image_transport's format."""
        return self._cdr(
            names.TYPES[names.IMAGE],
            header=self._header(stamp_ns, names.CAMERA),
            format=encoding,
            data=data.ravel(),
        )

    def image(self, stamp_ns: int, pixels: NDArray[Any], encoding: str) -> bytes:
        """Return an Image of pixels (H, W, C) in the given encoding."""
        height, width = pixels.shape[:2]
        data = np.ascontiguousarray(pixels).reshape(height, -1).view(np.uint8)
        return self._cdr(
            "sensor_msgs/msg/Image",
            header=self._header(stamp_ns, names.CAMERA),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=data.shape[1],
            data=data.ravel(),
        )

    def scan(self, stamp_ns: int, scan: LaserScan) -> bytes:
        """Return a LaserScan message of an observation; angles, ranges and times are float32.

        A sweep whose middle is later than the observation begins with it.
        """
        last = max(len(scan.ranges_m) - 1, 0)
        begun_ns = min(stamp_ns, scan.stamp_ns)
        return self._cdr(
            names.TYPES[names.SCAN],
            header=self._header(begun_ns, names.LASER),
            angle_min=scan.angle_min_rad,
            angle_max=scan.angle_min_rad + scan.angle_step_rad * last,
            angle_increment=scan.angle_step_rad,
            time_increment=2e-9 * (scan.stamp_ns - begun_ns) / max(last, 1),
            scan_time=0.0,
            range_min=scan.range_min_m,
            range_max=scan.range_max_m,
            ranges=np.ascontiguousarray(scan.ranges_m, dtype=np.float32),
            intensities=np.zeros(0, dtype=np.float32),
        )

    def points(
        self,
        stamp_ns: int,
        points_lidar: NDArray[np.float32],
        point_times_s: NDArray[np.float64] | None,
    ) -> bytes:
        """Return a PointCloud2 of points (N, 3) [m], lidar, with times (N,) [s] if known."""
        layout = [(axis, "<f4") for axis in "xyz"]
        if point_times_s is not None:
            layout.append(("time", "<f8"))
        rows = np.zeros(len(points_lidar), dtype=layout)
        for column, axis in enumerate("xyz"):
            rows[axis] = points_lidar[:, column]
        if point_times_s is not None:
            rows["time"] = point_times_s
        return self._cloud(stamp_ns, rows, names.LIDAR)

    def odometry(
        self,
        stamp_ns: int,
        T_frame_base: Transform,
        frame: str,
        *,
        base: str = names.BASE,
        covariance: NDArray[np.float64] | None = None,
        twist_base: NDArray[np.float64] | None = None,
        marks_twist: bool = False,
    ) -> bytes:
        """Return an Odometry of `base` in `frame`, T_frame_base (4, 4) [m].

        `covariance` (6, 6) [m, rad] in base is rotated to the axes of `frame`, as the message
        defines. `twist_base` is the velocity (6,) [m/s, rad/s]; unknown: zero, and with
        `marks_twist` the first entry of its covariance is -1.
        """
        moves = np.zeros(6) if twist_base is None else twist_base
        linear, angular = (
            self._new("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))
            for x, y, z in (moves[:3], moves[3:])
        )
        of_pose, of_twist = np.zeros((6, 6)), np.zeros(36)
        if covariance is not None:
            of_pose = _turned(covariance, T_frame_base)
        if twist_base is None and marks_twist:
            of_twist[0] = -1.0
        return self._cdr(
            names.TYPES[names.ODOMETRY],
            header=self._header(stamp_ns, frame),
            child_frame_id=base,
            pose=self._new(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self._pose(T_frame_base),
                covariance=of_pose.ravel(),
            ),
            twist=self._new(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self._new("geometry_msgs/msg/Twist", linear=linear, angular=angular),
                covariance=of_twist,
            ),
        )

    def imu(self, stamp_ns: int, measured: Mapping[Sensor, NDArray[np.float64]]) -> bytes:
        """Return an Imu of gyro (3,) [rad/s] and accelerometer (3,) [m/s^2]; missing: marked."""
        unknown = np.zeros(9)
        unknown[0] = -1.0
        vectors, covariances = {}, {}
        for sensor in (Sensor.GYRO, Sensor.ACCELEROMETER):
            x, y, z = measured[sensor].tolist() if sensor in measured else (0.0, 0.0, 0.0)
            vectors[sensor] = self._new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
            covariances[sensor] = np.zeros(9) if sensor in measured else unknown
        return self._cdr(
            names.TYPES[names.IMU],
            header=self._header(stamp_ns, names.BASE),
            orientation=self._new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=unknown,
            angular_velocity=vectors[Sensor.GYRO],
            angular_velocity_covariance=covariances[Sensor.GYRO],
            linear_acceleration=vectors[Sensor.ACCELEROMETER],
            linear_acceleration_covariance=covariances[Sensor.ACCELEROMETER],
        )

    def transforms(self, stamp_ns: int, parent: str, children: dict[str, Transform]) -> bytes:
        """Return a TFMessage of T_parent_child (4, 4) [m] for each child."""
        stamped = []
        for child, T_parent_child in children.items():
            pose = self._pose(T_parent_child)
            at = pose.position
            stamped.append(
                self._new(
                    "geometry_msgs/msg/TransformStamped",
                    header=self._header(stamp_ns, parent),
                    child_frame_id=child,
                    transform=self._new(
                        "geometry_msgs/msg/Transform",
                        translation=self._new("geometry_msgs/msg/Vector3", x=at.x, y=at.y, z=at.z),
                        rotation=pose.orientation,
                    ),
                )
            )
        return self._cdr(names.TYPES[names.TF], transforms=stamped)

    def text(self, text: str) -> bytes:
        """Return a std_msgs/String."""
        return self._cdr("std_msgs/msg/String", data=text)

    def _pose(self, T_a_b: Transform) -> Any:
        x, y, z = T_a_b[:3, 3].tolist()
        qx, qy, qz, qw = se3.to_quat_xyzw(T_a_b).tolist()
        return self._new(
            "geometry_msgs/msg/Pose",
            position=self._new("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self._new("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )

    def _cloud(self, stamp_ns: int, rows: NDArray[np.void], frame: str) -> bytes:
        """Return a PointCloud2 of a structured array (N,), whose dtype defines the fields."""
        fields = [
            self._new(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=offset,
                datatype=_DATATYPES[kind.str],
                count=1,
            )
            for name, (kind, offset, *_) in (rows.dtype.fields or {}).items()
        ]
        return self._cdr(
            names.TYPES[names.POINTS],
            header=self._header(stamp_ns, frame),
            height=1,
            width=len(rows),
            fields=fields,
            is_bigendian=False,
            point_step=rows.dtype.itemsize,
            row_step=rows.dtype.itemsize * len(rows),
            data=rows.view(np.uint8).ravel(),
            is_dense=True,
        )

    def _header(self, stamp_ns: int, frame: str) -> Any:
        sec, nanosec = divmod(int(stamp_ns), 10**9)
        stamp = self._new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _new(self, msgtype: str, **fields: Any) -> Any:
        return self._store.types[msgtype](**fields)

    def _cdr(self, msgtype: str, **fields: Any) -> bytes:
        return bytes(self._store.serialize_cdr(self._new(msgtype, **fields), msgtype))


def sensor_frames(rig: Rig) -> dict[str, Transform]:
    """Return the poses T_base_sensor (4, 4) [m] of the rig's sensors by their frames."""
    frames: dict[str, Transform] = {}
    if rig.camera:
        frames[names.CAMERA] = rig.camera.T_base_cam
    if rig.laser:
        frames[names.LASER] = rig.laser.T_base_laser
    if rig.lidar:
        frames[names.LIDAR] = rig.lidar.T_base_lidar
    return frames


def _turned(covariance: NDArray[np.float64], T_frame_base: Transform) -> NDArray[np.float64]:
    """Return a covariance (6, 6) in base, translation first, along the axes of the frame."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = T_frame_base[:3, :3]
    return np.asarray(turn @ covariance @ turn.T)
