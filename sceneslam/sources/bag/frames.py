"""Sensor poses on the robot, from a recording's transforms."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import islice

from sceneslam.ros import decode, names
from sceneslam.ros.decode import FrameTransform
from sceneslam.sources.bag.recording import Recording
from sceneslam.sources.bag.topics import first
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.se3 import Transform

_BASES = ("base_link", "base_footprint", "base")
_ROUNDING_M, _ROUNDING_RAD = 0.001, 0.001  # of transforms that were written as text
_FIRST_MOVING = 200  # messages of /tf that are searched for sensor mounts


class FrameTree:
    """The last transforms of /tf_static; for frames that are missing there, the first ones of /tf.

    Both may be in a robot's namespace. Where several robots name their frames alike, those of the
    innermost namespace of the topics `used` hold.
    """

    def __init__(
        self, recording: Recording, base_frame: str | None, used: Collection[str] = ()
    ) -> None:
        self._up: dict[str, FrameTransform] = {}  # by child
        self._moved: dict[str, set[str]] = {}  # static topic -> frames that it places differently
        topics = sorted(filter(is_of_transforms, recording.topics))
        topics.sort(key=lambda one: (not is_static(one), not is_beside(one, used), -one.count("/")))
        for topic in topics:
            self._up = self._read(recording, topic) | self._up
        frames = {*self._up, *(one.parent for one in self._up.values())}
        if base_frame is not None and base_frame not in frames:
            known = ", ".join(sorted(frames)) or "it has no /tf_static and no /tf"
            raise ConfigError("base_frame", base_frame, f"null or one of the recording's: {known}")
        self.base = base_frame or self._find_base(frames, recording, used)

    @property
    def is_empty(self) -> bool:
        """Tell whether the recording has no transforms."""
        return not self._up

    def is_base(self, frame: str) -> bool:
        """Tell whether a frame is the base; without a base, whether it has a base's name."""
        return frame == self.base or (self.base is None and has_base_name(frame))

    def T_base(self, frame: str) -> Transform | None:
        """Return T_base_frame (4, 4) [m]; None if no chain of transforms connects both."""
        return None if self.base is None else self.between(self.base, frame)

    def between(self, first: str, second: str) -> Transform | None:
        """Return T_first_second (4, 4) [m]; None if no chain of transforms connects both."""
        first_root, T_root_first = self._to_root(first)
        second_root, T_root_second = self._to_root(second)
        return se3.inverse(T_root_first) @ T_root_second if first_root == second_root else None

    def above(self, frame: str) -> Sequence[str]:
        """Return the frames that a frame is placed in, from its parent to its root."""
        found = [frame]
        while found[-1] in self._up and self._up[found[-1]].parent not in found:
            found.append(self._up[found[-1]].parent)
        return found[1:]

    def moved(self) -> Iterator[str]:
        """Yield a sentence per topic of static transforms that places frames differently."""
        for topic, frames in self._moved.items():
            named = ", ".join(map(repr, sorted(frames)))
            yield f"{topic} places frame {named} at different poses: the last one holds"

    def _read(self, recording: Recording, topic: str) -> dict[str, FrameTransform]:
        """Return a topic's transforms by child: of a static one the last, as in tf2."""
        found: dict[str, FrameTransform] = {}
        count = None if is_static(topic) else _FIRST_MOVING
        for message in islice(recording.messages({topic}), count):
            for one in decode.transforms(recording.decode(message)):
                before = found.setdefault(one.child, one)
                if is_static(topic):
                    found[one.child] = one
                    if not _is_same(before, one):
                        self._moved.setdefault(topic, set()).add(one.child)
        return found

    def _find_base(
        self, frames: Collection[str], recording: Recording, used: Collection[str]
    ) -> str | None:
        """Return the frame with a base's name, else the one with it as its last part.

        Of several of these, the one above the sensors `used`; None if none of them is below one.
        """
        for name in _BASES:
            if name in frames:
                return name
        for name in _BASES:
            found = {frame for frame in frames if _last_part(frame) == name}
            if len(found) > 1:
                messages = (first(recording, topic) for topic in used)
                sensors = {decode.frame_id(one) for one in messages if one is not None}
                return self._base_above(sensors, found)
            if found:
                return found.pop()
        return None

    def _base_above(self, sensors: Collection[str], bases: set[str]) -> str | None:
        """Return the base above all sensors that are below any, the outermost; None if none is.

        Raises InputError if none is above all of them.
        """
        above = [bases.intersection([frame, *self.above(frame)]) for frame in sensors]
        above = [found for found in above if found]
        fit = set.intersection(*above) if above else set()
        fit = {frame for frame in fit if not fit.intersection(self.above(frame))}
        if above and not fit:
            several = sorted(set.union(*above))
            raise InputError(
                f"base_frame: several frames hold the sensors ({', '.join(several)}): "
                f"choose one, such as source.base_frame={several[0]}"
            )
        return fit.pop() if fit else None

    def _to_root(self, frame: str) -> tuple[str, Transform]:
        T_root_frame = se3.identity()
        for parent in self.above(frame):
            T_root_frame = self._up[frame].T_parent_child @ T_root_frame
            frame = parent
        return frame, T_root_frame


def is_of_transforms(topic: str) -> bool:
    """Tell whether a topic's name, in any namespace, is that of transforms."""
    return is_static(topic) or _last_part(topic) == _last_part(names.TF)


def is_static(topic: str) -> bool:
    """Tell whether a topic's name, in any namespace, is that of transforms that do not change."""
    return _last_part(topic) == _last_part(names.TF_STATIC)


def has_base_name(frame: str) -> bool:
    """Tell whether a frame's name, in any namespace, is that of a base."""
    return _last_part(frame) in _BASES


def is_beside(topic: str, used: Collection[str]) -> bool:
    """Tell whether a topic's namespace holds one of the topics used."""
    namespace = topic.rpartition("/")[0] + "/"
    return any(one.startswith(namespace) for one in used)


def _is_same(before: FrameTransform, now: FrameTransform) -> bool:
    T_before_now = se3.inverse(before.T_parent_child) @ now.T_parent_child
    return before.parent == now.parent and se3.is_within(T_before_now, _ROUNDING_M, _ROUNDING_RAD)


def _last_part(name: str) -> str:
    """Return the name without its namespace: laser of husky/laser."""
    return name.rpartition("/")[2]
