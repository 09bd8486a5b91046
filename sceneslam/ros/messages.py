"""Decoding of messages by the definitions in the recording."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

# Between the files of a definition in IDL, as MCAP joins them (its format registry, "ros2idl").
_IDL_HEAD = re.compile(r"^=+\s*\nIDL: .*$", re.MULTILINE)


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicType:
    """Type, encoding and number of a topic's messages."""

    msgtype: str  # `sensor_msgs/msg/Image`, for ROS 1 too
    encoding: str  # of messages: `cdr` or `ros1`
    definition: str  # in `definition_format`; "" if not recorded
    definition_format: str  # `ros2msg`, `ros1msg` or `ros2idl`
    count: int  # messages

    @classmethod
    def of_network(cls, msgtype: str, count: int = 0) -> TopicType:
        """Return a live topic of a standard type."""
        kind = {"msgtype": msgtype, "encoding": "cdr", "definition": ""}
        return cls(**kind, definition_format="ros2msg", count=count)

    def with_count(self, count: int) -> TopicType:
        """Return a copy with another count."""
        return replace(self, count=count)


class MessageDecoder:
    """Decodes messages; reads a type's definition at its first message."""

    def __init__(self, topics: Mapping[str, TopicType]) -> None:
        self._topics = topics
        self._stores: dict[str, Any] = {}  # by topic, as files may hold two definitions of one type

    def decode(self, topic: str, data: bytes) -> Any:
        """Return the message, None if its bytes or its definition are invalid."""
        kind = self._topics[topic]
        if topic not in self._stores:
            self._stores[topic] = _typestore(kind)
        store = self._stores[topic]
        if store is None:
            return None
        try:
            if kind.encoding == "ros1":
                return store.deserialize_ros1(data, kind.msgtype)
            return store.deserialize_cdr(data, kind.msgtype)
        except Exception:  # generated code raises any exception for invalid bytes
            return None


def _typestore(kind: TopicType) -> Any:
    """Return a typestore with the type, None if its definition cannot be read."""
    from rosbags.typesys import (
        Stores,
        TypesysError,
        get_types_from_idl,
        get_types_from_msg,
        get_typestore,
    )

    standard = get_typestore(Stores.ROS1_NOETIC if kind.encoding == "ros1" else Stores.LATEST)
    if not kind.definition:
        return standard if kind.msgtype in standard.types else None
    store = get_typestore(Stores.EMPTY)
    try:
        if kind.definition_format == "ros2idl":
            for text in _IDL_HEAD.split(kind.definition):
                if text.strip():
                    store.register(get_types_from_idl(text))
        else:
            # Bags from before 2011 have the header in a package that no longer exists.
            text = kind.definition.replace("roslib/Header", "std_msgs/Header")
            store.register(get_types_from_msg(text, kind.msgtype))
    except (TypesysError, ValueError, KeyError):
        return None
    is_known = kind.msgtype in store.types
    return store if is_known and _has_standard_fields(store, standard) else None


def _has_standard_fields(store: Any, standard: Any) -> bool:
    """Tell whether the standard types have all fields: a definition may be damaged."""
    for name, (_, fields) in store.fielddefs.items():
        expected = standard.fielddefs.get(name, ((), ()))[1]
        if not {field for field, _ in expected} <= {field for field, _ in fields}:
            return False
    return True
