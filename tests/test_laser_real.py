"""The laser module on a real log, against relative poses that people checked."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import yaml
from ros_recordings import make_source

from sceneslam.modules.slam.laser.module import LaserSlam
from sceneslam.types import se3
from sceneslam.types.observation import LaserScan, Observation, TrackingStatus
from sceneslam.types.rig import Laser, Rig, Sensor


def read_log(path, first, last):
    """Return scans of a CARMEN log: stamp text, observation."""
    found = []
    with path.open() as log:
        lines = (line for line in log if line.startswith("FLASER"))
        for line in islice(lines, first, last):
            words = line.split()
            count = int(words[1])
            ranges = np.array(words[2 : 2 + count], np.float32)
            stamp_ns = len(found) * 200_000_000  # the log's own stamps go back and forth
            scan = LaserScan(
                stamp_ns=stamp_ns,
                ranges_m=np.where(ranges > 80, np.inf, ranges).astype(np.float32),
                angle_min_rad=-np.pi / 2,
                angle_step_rad=np.pi / 180,
                range_min_m=0.01,
                range_max_m=80.0,
            )
            T_odom_base = se3.from_xy_yaw(*(float(word) for word in words[5 + count : 8 + count]))
            observation = Observation(stamp_ns=stamp_ns, scan=scan, T_odom_base=T_odom_base)
            found.append((words[8 + count], observation))
    return found


def relation_errors(path, T_world_base):
    """Return translation [m] and yaw [rad] errors (N, 2) of the relations between known stamps."""
    errors = []
    for line in path.read_text().splitlines():
        first, second, x, y, _, _, _, yaw = line.split()
        if first in T_world_base and second in T_world_base:
            T_first_second = se3.inverse(T_world_base[first]) @ T_world_base[second]
            T_true = se3.from_xy_yaw(float(x), float(y), float(yaw))
            T_off = se3.inverse(T_true) @ T_first_second
            errors.append([np.hypot(*T_off[:2, 3]), abs(se3.yaw_rad(T_off))])
    return np.array(errors)


def make_module():
    conf = Path(__file__).resolve().parent.parent / "conf/slam/laser.yaml"
    settings = yaml.safe_load(conf.read_text())
    settings.pop("_target_")
    return LaserSlam(**settings)


def test_real_corridors_are_tracked_far_better_than_by_odometry(shared_data):
    folder = shared_data / "carmen_intel"
    module = make_module()
    module.activate(Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser()))
    log = read_log(folder / "intel.clf", 0, 1200)
    trackings = {stamp: module.track(observation) for stamp, observation in log}
    assert TrackingStatus.LOST not in {tracking.status for tracking in trackings.values()}
    relations = folder / "intel.relations"
    laser = relation_errors(relations, {s: t.T_local_base for s, t in trackings.items()})
    odometry = relation_errors(relations, {s: o.T_odom_base for s, o in log})
    assert len(laser) > 100
    assert laser[:, 0].mean() < 0.03
    assert laser[:, 1].mean() < 0.5 * odometry[:, 1].mean()


def test_robot_that_backs_down_a_corridor_is_not_held_by_what_it_saw(shared_data):
    """The log backwards: all that is new is beside the laser, where most of its beams are."""
    module = make_module()
    module.activate(Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser()))
    log = read_log(shared_data / "carmen_aces" / "aces.clf", 3050, 3200)
    stamps_ns = [observation.stamp_ns for _, observation in log]
    backwards = [
        replace(each, stamp_ns=stamp_ns, scan=replace(each.scan, stamp_ns=stamp_ns))
        for stamp_ns, (_, each) in zip(stamps_ns, reversed(log), strict=True)
    ]
    poses = [module.track(observation).T_local_base for observation in backwards]
    moved_m, moved_by_wheels_m = (
        np.linalg.norm((se3.inverse(path[0]) @ path[-1])[:2, 3])
        for path in (poses, [observation.T_odom_base for observation in backwards])
    )
    assert moved_by_wheels_m > 9.0
    assert abs(moved_m - moved_by_wheels_m) < 0.2


@pytest.mark.parametrize("first", [0, 20, 40, 60])
def test_slice_of_a_lidar_is_a_laser_too(shared_data, first):
    source = make_source("kitti", shared_data / "kitti_raw_2011_09_26_drive_0001")
    module = make_module()
    module.activate(source.rig)
    true = source.ground_truth().trajectory.T_world_base[first:]
    trackings = [module.track(observation) for observation in list(source)[first : first + 30]]
    assert TrackingStatus.LOST not in {tracking.status for tracking in trackings}
    off = [
        np.hypot(*(true[0] @ t.T_local_base - T_true)[:2, 3])
        for t, T_true in zip(trackings, true, strict=False)
    ]
    assert max(off) < 0.5  # 0.34, 0.21, 0.10, 0.11 over 38 m
