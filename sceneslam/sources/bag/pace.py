"""Which streams are silent, and which sensor sets the pace of observations."""

from __future__ import annotations

from collections.abc import Mapping

from sceneslam.sources.bag.observation import PRIMARY
from sceneslam.types.rig import Sensor


class StreamPace:
    """Detects topics without a message for longer than `silent_after_s`.

    Times are those of arrival: on this machine, or in the recording.
    """

    def __init__(self, topics: Mapping[Sensor, str], silent_after_s: float, now_ns: int) -> None:
        self._topics = topics
        self._silent_ns = round(silent_after_s * 1e9)
        self._heard_ns = dict.fromkeys(topics.values(), now_ns)
        self._silent: set[str] = set()

    @property
    def sensor(self) -> Sensor:
        """Return the sensor that sets the pace of observations: the first that is alive."""
        ranked = [sensor for sensor in PRIMARY if sensor in self._topics]
        alive = [sensor for sensor in ranked if not self.is_silent(self._topics[sensor])]
        return (alive or ranked)[0]

    def is_silent(self, topic: str) -> bool:
        """Tell whether a topic is silent."""
        return topic in self._silent

    def hear(self, topic: str, arrived_ns: int) -> bool:
        """Record the arrival of a message; return whether its topic was silent."""
        was_silent = topic in self._silent
        self._heard_ns[topic] = arrived_ns
        self._silent.discard(topic)
        return was_silent

    def look(self, now_ns: int) -> list[str]:
        """Return the topics that have fallen silent since the last look."""
        fallen = [
            topic
            for topic, heard_ns in self._heard_ns.items()
            if topic not in self._silent and now_ns - heard_ns > self._silent_ns
        ]
        self._silent.update(fallen)
        return fallen
