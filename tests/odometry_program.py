"""A SLAM program in Python that believes the wheels; it answers for several stamps at once."""

import sys

import numpy as np

from sceneslam.modules.slam.process.client import LOST, as_text, pose, poses, serve


class OdometryProgram:
    requires = "odometry"

    def __init__(self, late):
        self.late, self.waiting, self.first, self.latest = late, [], None, np.eye(4)

    def activate(self, rig):
        print("sensors:", as_text(rig["sensors"]))  # noqa: T201 - must not get between

    def set_scene(self, scene):
        self.scene = scene

    def track(self, observation):
        stamp_ns = int(observation["stamp_ns"])
        if "T_odom_base" not in observation:
            return pose(stamp_ns, self.latest, LOST)
        T_odom_base = observation["T_odom_base"]
        if self.first is None:
            self.first = np.linalg.inv(T_odom_base)
        self.latest = self.first @ T_odom_base
        self.waiting.append((stamp_ns, self.latest))
        if len(self.waiting) < self.late:
            return poses([], [])
        stamps, transforms = zip(*self.waiting, strict=True)
        self.waiting = []
        return poses(list(stamps), list(transforms))

    def trajectory(self):
        return poses([], [])

    def map(self):
        return {"points.points": np.ones((5, 3), np.float32)}


serve(OdometryProgram(int(sys.argv[1]) if len(sys.argv) > 1 else 1))
