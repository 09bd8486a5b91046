"""Sensor poses on the robot, from a recording's transforms."""

from __future__ import annotations

from itertools import islice

from sceneslam.ros import decode, names
from sceneslam.sources.bag.recording import Recording
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.se3 import Transform

_BASES = ("base_link", "base_footprint", "base")
_FIRST_MOVING = 200  # messages of /tf that are searched for sensor mounts


class FrameTree:
    """The transforms of /tf_static; for frames that are missing there, the first ones of /tf."""

    def __init__(self, recording: Recording, base_frame: str | None) -> None:
        self._up: dict[str, tuple[str, Transform]] = {}  # child -> parent, T_parent_child
        for topic, count in ((names.TF_STATIC, None), (names.TF, _FIRST_MOVING)):
            if topic not in recording.topics:
                continue
            for message in islice(recording.messages({topic}), count):
                for one in decode.transforms(recording.decode(message)):
                    self._up.setdefault(one.child, (one.parent, one.T_parent_child))
        frames = {*self._up, *(parent for parent, _ in self._up.values())}
        if base_frame is not None and base_frame not in frames:
            known = ", ".join(sorted(frames)) or "it has no /tf_static and no /tf"
            raise ConfigError("base_frame", base_frame, f"null or one of the recording's: {known}")
        self.base = base_frame or next((name for name in _BASES if name in frames), None)

    def is_base(self, frame: str) -> bool:
        """Tell whether a frame is the base; without transforms, whether it has a base's name."""
        return frame == self.base or (self.base is None and frame in _BASES)

    def T_base(self, frame: str) -> Transform | None:
        """Return T_base_frame (4, 4) [m]; None if no chain of transforms connects both."""
        return None if self.base is None else self.between(self.base, frame)

    def between(self, first: str, second: str) -> Transform | None:
        """Return T_first_second (4, 4) [m]; None if no chain of transforms connects both."""
        first_root, T_root_first = self._to_root(first)
        second_root, T_root_second = self._to_root(second)
        return se3.inverse(T_root_first) @ T_root_second if first_root == second_root else None

    def _to_root(self, frame: str) -> tuple[str, Transform]:
        T_root_frame, met = se3.identity(), {frame}
        while frame in self._up:
            frame, T_parent_child = self._up[frame]
            if frame in met:
                break
            met.add(frame)
            T_root_frame = T_parent_child @ T_root_frame
        return frame, T_root_frame
