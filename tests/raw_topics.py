"""A recording of ours as a RealSense robot's topics: raw images, 16-bit depth, usual names."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from sceneslam.ros import names
from sceneslam.ros.encode import Encoder
from sceneslam.sources.bag.open_recording import open_recording

IMAGE, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
_PICTURES = {names.IMAGE: (IMAGE, "rgb8"), names.DEPTH: (DEPTH, "16UC1")}
_COMPRESSED_DEPTH_HEADER = 12


def write_raw(recorded: Path, path: Path, *, without: Collection[str] = ()) -> Path:
    """Write the sensor topics of a recording, images decoded; return the path."""
    recording, encoder = open_recording(recorded), Encoder()
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="test")
        channels: dict[str, int] = {}
        for message in recording.messages(recording.topics.keys() - set(without)):
            topic, data = message.topic, message.data
            kind = recording.topics[topic].msgtype
            if topic in _PICTURES:
                topic, encoding = _PICTURES[topic]
                kind = "sensor_msgs/msg/Image"
                data = encoder.image(message.log_ns, _pixels(recording.decode(message)), encoding)
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", encoder.definition(kind))
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], message.log_ns, data, message.log_ns)
        writer.finish()
    return path


def _pixels(message) -> np.ndarray:
    """Return colours (H, W, 3) RGB, or depth (H, W, 1) in millimetres, of a compressed image."""
    stored = message.data.tobytes()
    if "compressedDepth" in message.format:
        stored = stored[_COMPRESSED_DEPTH_HEADER:]
    pixels = cv2.imdecode(np.frombuffer(stored, np.uint8), cv2.IMREAD_UNCHANGED)
    return pixels[:, :, None] if pixels.ndim == 2 else pixels[:, :, ::-1]
