"""Small recordings for the tests of sources: any message, any topic."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from hydra import compose, initialize_config_module
from hydra.utils import get_class
from omegaconf import OmegaConf

STAMP_NS = 1_700_000_000_123_456_789


def make_source(name: str, path: Path, **changes: Any) -> Any:
    """Build a source from its YAML with some values changed (dictionaries are merged)."""
    config = _source_config(name)
    config["path"] = str(path)
    for key, value in changes.items():
        config[key] = {**config[key], **value} if isinstance(value, dict) else value
    return get_class(config.pop("_target_"))(**config)


@cache
def _composed(name: str) -> Any:
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        return compose(f"source/{name}").source


def _source_config(name: str) -> Any:
    return OmegaConf.to_container(_composed(name))


class Recorder:
    """Writes messages to an MCAP file in the order they are added."""

    def __init__(self, path: Path) -> None:
        from mcap.writer import CompressionType, Writer
        from rosbags.typesys import Stores, get_typestore

        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=4096, compression=CompressionType.LZ4)
        self._writer.start(profile="ros2", library="test")
        self._channels: dict[str, int] = {}

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.finish()
        self._file.close()

    def new(self, msgtype: str, **fields: Any) -> Any:
        return self._store.types[msgtype](**fields)

    def header(self, stamp_ns: int, frame: str = "") -> Any:
        stamp = self.new(
            "builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        return self.new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def add(self, topic: str, log_ns: int, message: Any) -> None:
        msgtype = message.__msgtype__
        if topic not in self._channels:
            text = self._store.generate_msgdef(msgtype, ros_version=2)[0].encode()
            schema = self._writer.register_schema(name=msgtype, encoding="ros2msg", data=text)
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="cdr", schema_id=schema
            )
        data = bytes(self._store.serialize_cdr(message, msgtype))
        self._writer.add_message(self._channels[topic], log_ns, data, log_ns)

    def image(
        self,
        topic: str,
        stamp_ns: int,
        pixels: np.ndarray,
        encoding: str = "bgr8",
        *,
        frame: str = "cam",
        is_bigendian: bool = False,
        padding: int = 0,
        log_ns: int | None = None,  # None: recorded at its stamp
    ) -> None:
        order = ">" if is_bigendian else "<"
        rows = pixels.astype(pixels.dtype.newbyteorder(order)).reshape(len(pixels), -1)
        data = np.ascontiguousarray(rows).view(np.uint8)
        data = np.pad(data, ((0, 0), (0, padding)))
        message = self.new(
            "sensor_msgs/msg/Image",
            header=self.header(stamp_ns, frame),
            height=len(pixels),
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=int(is_bigendian),
            step=data.shape[1],
            data=data.ravel(),
        )
        self.add(topic, stamp_ns if log_ns is None else log_ns, message)

    def compressed(self, topic: str, stamp_ns: int, data: bytes, encoding: str) -> None:
        message = self.new(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(stamp_ns, "cam"),
            format=encoding,
            data=np.frombuffer(data, np.uint8),
        )
        self.add(topic, stamp_ns, message)

    def camera_info(self, topic: str, stamp_ns: int, size_wh: tuple[int, int]) -> None:
        from sceneslam.ros.encode import Encoder
        from sceneslam.types.rig import Camera

        camera = Camera(size_wh=size_wh, fx=50.0, fy=51.0, cx=20.0, cy=15.0)
        data = Encoder().camera_info(stamp_ns, camera)
        message = self._store.deserialize_cdr(data, "sensor_msgs/msg/CameraInfo")
        self.add(topic, stamp_ns, message)

    def scan(
        self,
        topic: str,
        stamp_ns: int,
        ranges: list[float],
        *,
        frame: str = "laser",
        **changes: float,
    ) -> None:
        fields = {
            "angle_min": -1.0,
            "angle_max": 1.0,
            "angle_increment": 0.1,
            "time_increment": 0.0,
            "scan_time": 0.0,
            "range_min": 0.1,
            "range_max": 10.0,
            **changes,
        }
        message = self.new(
            "sensor_msgs/msg/LaserScan",
            header=self.header(stamp_ns, frame),
            ranges=np.array(ranges, np.float32),
            intensities=np.zeros(0, np.float32),
            **fields,
        )
        self.add(topic, stamp_ns, message)

    def transform(self, parent: str, child: str, x_m: float) -> Any:
        """Return a TransformStamped: `child` is so far ahead of `parent`."""
        return self.new(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(STAMP_NS, parent),
            child_frame_id=child,
            transform=self.new(
                "geometry_msgs/msg/Transform",
                translation=self.new("geometry_msgs/msg/Vector3", x=x_m, y=0.0, z=0.0),
                rotation=self.new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            ),
        )
