"""The stamps of recorded messages, also where publishers set none."""

from __future__ import annotations

from typing import Any

from sceneslam.ros import decode
from sceneslam.sources.bag.recording import Message, Recording


class StampReader:
    """Reads the stamps of a recording's messages.

    The time of recording stands in for stamps where neither the first nor the last message of a
    topic has one. In other topics it would be of another clock: a simulator's nodes, which stamp by
    its clock, publish zeros until they have received it.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._lacking: dict[str, bool] = {}  # topic -> none of its messages has a stamp

    def stamp_ns(self, message: Message, decoded: Any) -> int | None:
        """Return the stamp [ns] of a message and its decoded content, None if it has none."""
        own_ns = decode.stamp_ns(decoded)
        if own_ns:
            return own_ns
        return message.log_ns if self._lacks_stamps(message.topic) else None

    def _lacks_stamps(self, topic: str) -> bool:
        if topic not in self._lacking:
            ends = (next(self._recording.messages({topic}), None), self._recording.last(topic))
            values = [self._recording.decode(one) for one in ends if one is not None]
            self._lacking[topic] = not any(
                decode.stamp_ns(value) for value in values if value is not None
            )
        return self._lacking[topic]
