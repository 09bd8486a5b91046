"""A node that answers the odometry it hears with a pose, as a SLAM node would.

    python tests/ros2_odometry_node.py DOMAIN BEHAVIOUR

BEHAVIOUR: `good`, `silent`, `unsure` (its covariance is large), `ends` (after three answers).
"""

from __future__ import annotations

import sys
import threading

import numpy as np
from rosbags.typesys import Stores, get_typestore

from sceneslam.ros.transport.transport import Network, Qos, open_transport

ODOMETRY = "nav_msgs/msg/Odometry"


def main(domain_id: int, behaviour: str) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    transport = open_transport(Network(domain_id=domain_id))
    publisher = transport.publisher("/slam/pose", ODOMETRY, Qos.RELIABLE)
    ended, count = threading.Event(), 0

    def heard(arrival) -> None:
        nonlocal count
        count += 1
        if behaviour == "silent":
            return
        message = store.deserialize_cdr(arrival.cdr, ODOMETRY)
        message.header.frame_id = "map"
        if behaviour == "unsure":
            message.pose.covariance = np.eye(6).reshape(-1) * 25.0
        publisher.publish(bytes(store.serialize_cdr(message, ODOMETRY)))
        if behaviour == "ends" and count == 3:
            ended.set()

    transport.subscribe("/odom", ODOMETRY, heard, Qos.RELIABLE)
    print("listening", flush=True)  # noqa: T201
    ended.wait()
    transport.close()


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
