"""A run must not take its own results for those of a SLAM node of ROS 2."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sceneslam.ros import names
from sceneslam.ros.transport.transport import Network
from sceneslam.types.errors import ConfigError

_NODE = "sceneslam.modules.slam.ros2_node.module.Ros2Node"
_SINK = "sceneslam.sinks.ros2.sink.Ros2Sink"


def check_echo(slam: Mapping[str, Any], sinks: Mapping[str, Any]) -> None:
    """Raise ConfigError if a sink publishes what is read from a node, on the node's domain.

    A node that has ended would go on tracking by the sink's `map -> odom`.
    """
    for key, node in slam.items():
        for name, sink in sinks.items():
            if (node["_target_"], sink["_target_"]) != (_NODE, _SINK):
                continue
            domain_id = node["network"]["domain_id"]
            if _domain(domain_id) == _domain(sink["domain_id"]) and _is_same(node, sink):
                raise ConfigError(
                    f"slam.{key}.network.domain_id",
                    domain_id,
                    f"another domain than sinks.{name}.domain_id ({sink['domain_id']}), on which "
                    "the run publishes what is read from the node: map -> odom, or /map",
                )


def _is_same(node: Mapping[str, Any], sink: Mapping[str, Any]) -> bool:
    """Tell whether a sink publishes the transform or the map that is read from a node."""
    frames = (sink["map_frame"], sink["odom_frame"])
    is_heard = node["pose_kind"] == "tf" and frames == (names.MAP, names.ODOM)
    return is_heard or node["topics"]["map"] == names.RESULT_MAP


def _domain(domain_id: int | None) -> int:
    return Network(domain_id=domain_id).domain()
