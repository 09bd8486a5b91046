"""The ground truth of a recording."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sceneslam.ros import decode
from sceneslam.sources.bag.frames import FrameTree, has_base_name
from sceneslam.sources.bag.recording import Recording
from sceneslam.sources.bag.stamps import StampReader
from sceneslam.sources.bag.topics import BagTopics, first
from sceneslam.types import se3
from sceneslam.types.rig import Rig
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth, SceneChange

CAMERA, BASE = "camera", "base"


def read_truth(
    recording: Recording, topics: BagTopics, frames: FrameTree, rig: Rig, truth_frame: str | None
) -> GroundTruth | None:
    """Return the true poses of `base` and the true scenes; None if neither is recorded.

    `truth_frame` is the frame of the recorded poses, `camera` (optical) or `base`. None: the frame
    that the messages name; without a name, `base` if the recording has that frame, else `camera`.
    """
    trajectory = Trajectory.empty()
    scenes: tuple[SceneChange, ...] = ()
    if topics.ground_truth:
        T_base_tracked = _tracked(recording, topics.ground_truth, frames, rig, truth_frame)
        trajectory = _trajectory(recording, topics.ground_truth, se3.inverse(T_base_tracked))
    if topics.scene:
        scenes = _scenes(recording, topics.scene)
    if not len(trajectory) and not scenes:
        return None
    return GroundTruth(trajectory=trajectory, scenes=scenes)


def unplaced_body(recording: Recording, topics: BagTopics, frames: FrameTree) -> Iterator[str]:
    """Yield a sentence if the recorded poses are of a frame that no transform places."""
    child = _child(recording, topics.ground_truth) if topics.ground_truth else ""
    is_placed = frames.is_base(child) or has_base_name(child) or frames.T_base(child) is not None
    if child and not is_placed:
        yield (
            f"{topics.ground_truth}: no transform connects frame {child!r} with the robot's base "
            "(source.base_frame): its poses are taken for those of base; "
            "source.ground_truth_frame says whose they are"
        )


def _tracked(
    recording: Recording, topic: str, frames: FrameTree, rig: Rig, truth_frame: str | None
) -> Transform:
    """Return T_base_tracked (4, 4) [m], where `tracked` is the frame of the recorded poses."""
    child = _child(recording, topic)
    T_base_child = frames.T_base(child) if child else None
    if truth_frame is None and T_base_child is not None:
        return T_base_child
    is_camera = truth_frame == CAMERA or (
        truth_frame is None and not child and frames.base is None and _is_pose(recording, topic)
    )
    return rig.camera.T_base_cam if is_camera and rig.camera else se3.identity()


def _child(recording: Recording, topic: str) -> str:
    """Return the frame whose poses a topic holds, "" if it is not named."""
    message = first(recording, topic)
    return "" if message is None else decode.child_frame_id(message)


def _is_pose(recording: Recording, topic: str) -> bool:
    """Tell whether the topic's message type does not name the tracked frame."""
    return "Pose" in recording.topics[topic].msgtype


def _trajectory(recording: Recording, topic: str, T_tracked_base: Transform) -> Trajectory:
    poses: dict[int, Transform] = {}
    stamps = StampReader(recording)
    for message in recording.messages({topic}):
        decoded = recording.decode(message)
        T_gt_tracked = None if decoded is None else _pose(decoded)
        stamp_ns = None if decoded is None else stamps.stamp_ns(message, decoded)
        if T_gt_tracked is not None and stamp_ns is not None:
            poses[stamp_ns] = T_gt_tracked @ T_tracked_base
    if not poses:
        return Trajectory.empty()
    stamps_ns = np.array(sorted(poses), dtype=np.int64)
    return Trajectory(
        stamps_ns=stamps_ns, T_world_base=np.stack([poses[int(stamp)] for stamp in stamps_ns])
    )


def _pose(message: Any) -> Transform | None:
    if message.__msgtype__ == "geometry_msgs/msg/TransformStamped":
        return decode.transform(message.transform.translation, message.transform.rotation)
    is_plain = message.__msgtype__ == "geometry_msgs/msg/PoseStamped"
    pose = message.pose if is_plain else message.pose.pose
    return decode.transform(pose.position, pose.orientation)


def _scenes(recording: Recording, topic: str) -> tuple[SceneChange, ...]:
    """Return the scene changes; repetitions of the same scene are left out."""
    changes: list[SceneChange] = []
    for message in recording.messages({topic}):
        decoded = recording.decode(message)
        if decoded is not None and (not changes or changes[-1].scene != decoded.data):
            changes.append(SceneChange(stamp_ns=message.log_ns, scene=str(decoded.data)))
    return tuple(changes)
