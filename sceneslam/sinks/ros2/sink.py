"""The sink that publishes a run to a robot's ROS 2 network."""

from __future__ import annotations

from sceneslam.interfaces import LiveMapper
from sceneslam.ros.transport.transport import Network, open_transport
from sceneslam.sinks.ros2.topics import TopicSink


class Ros2Sink(TopicSink):
    """Publishes over DDS without ROS, or through rclpy."""

    def __init__(
        self,
        transport: str,
        domain_id: int | None,
        discovery: str | None,
        map_frame: str,
        odom_frame: str,
        base_frame: str,
        tf_ahead_s: float,
        map_every_s: float,
        mapper: LiveMapper,
    ) -> None:
        network = Network(transport=transport, domain_id=domain_id, discovery=discovery)
        super().__init__(
            lambda: open_transport(network),
            map_frame=map_frame,
            odom_frame=odom_frame,
            base_frame=base_frame,
            tf_ahead_s=tf_ahead_s,
            map_every_s=map_every_s,
            mapper=mapper,
        )
