"""What is put around a library that registers clouds: bounds, bridges, weak directions."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from importlib.machinery import ModuleSpec
from types import ModuleType

import numpy as np
import pytest
import yaml
from documentation import ROOT, write_files

from sceneslam.modules.slam.cloud_map import CloudMap
from sceneslam.modules.slam.cloud_odometry import CloudOdometry
from sceneslam.modules.slam.degeneracy import Localizability
from sceneslam.modules.slam.quiet import quiet
from sceneslam.modules.slam.rko_lio import RkoLio
from sceneslam.testing import RIG, room_observation
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import TrackingStatus

SETTINGS = {
    "voxel_m": 0.2,
    "depth_range_max_m": 6.0,
    "depth_stride_px": 8,
    "deskew": False,
    "noise_m": None,
    "overlap_min_ratio": 0.0,
    "weak_ratio": 0.0,
    "speed_max_m_s": 5.0,
    "turn_max_rad_s": 3.0,
}


class Answering(CloudMap):
    """A library that answers with what it is told to, or with the guess."""

    def __init__(self):
        super().__init__(voxel_m=0.2, range_max_m=20.0)
        self.answers, self.added, self.guesses_off_m = {}, 0, []

    def register(self, cloud, T_local_guess, observation):
        self.source = self.dense = cloud
        self.guesses_off_m.append(self.guess_off_m)
        answer = self.answers.get(observation.stamp_ns, lambda T: T)
        return answer(T_local_guess)

    def add(self, T_local_guess, T_local_base):
        self.added += 1

    def points(self):
        return np.zeros((0, 3))

    def localizability(self):
        """Return that little holds the pose along x."""
        ratios = np.array([0.1, 1.0, 1.0, 1.0, 1.0, 1.0])
        return Localizability(ratios=ratios, directions=np.eye(6), scale=np.eye(6))


class Around(CloudOdometry):
    def make_map(self, voxel_m, reader):
        self.library = Answering()
        return self.library


def driven(answers, *, odometry=True, **settings):
    module = Around(**(SETTINGS | settings))
    module.activate(RIG)
    module.library.answers = {room_observation(index).stamp_ns: answers[index] for index in answers}
    silent = {} if odometry else {"T_odom_base": None}
    found = [module.track(replace(room_observation(index), **silent)) for index in range(8)]
    return found, module.library


def test_the_settings_that_the_guide_shows_make_a_module(tmp_path):
    write_files(ROOT / "docs" / "own_module.md", tmp_path)
    settings = yaml.safe_load((tmp_path / "my_conf" / "slam" / "my_icp.yaml").read_text())
    del settings["_target_"]
    Around(**settings).activate(RIG)


@pytest.mark.parametrize(
    "answer",
    [lambda T: None, lambda T: T * np.nan, lambda T: T @ se3.from_xy_yaw(9.0, 0.0, 0.0)],
    ids=["refused", "no number", "too far"],
)
def test_an_answer_that_cannot_be_is_bridged_by_odometry(answer):
    found, library = driven({4: answer})
    assert [one.status for one in found[3:6]] == [
        TrackingStatus.TRACKING,
        TrackingStatus.DEGRADED,
        TrackingStatus.TRACKING,
    ]
    T_first = room_observation(0).T_odom_base
    T_true = se3.inverse(T_first) @ room_observation(4).T_odom_base
    assert np.linalg.norm((se3.inverse(T_true) @ found[4].T_local_base)[:3, 3]) < 0.02
    assert library.added == 7  # the cloud that was not placed stays out of the map


def test_without_odometry_such_an_answer_is_lost():
    found, _ = driven({4: lambda T: None}, odometry=False)
    assert found[4].status is TrackingStatus.LOST and found[4].covariance is None
    assert found[5].status is TrackingStatus.TRACKING


@pytest.mark.parametrize(
    ("odometry", "speed_max_m_s", "due_m_s"),
    [(False, 5.0, 5.0), (False, 99.0, 50.0), (True, 5.0, 0.0)],
)
def test_only_the_first_motion_of_a_lidar_without_odometry_may_be_any(
    odometry, speed_max_m_s, due_m_s
):
    _, library = driven({}, odometry=odometry, speed_max_m_s=speed_max_m_s)
    interval_s = (room_observation(1).stamp_ns - room_observation(0).stamp_ns) * 1e-9
    assert library.guesses_off_m == pytest.approx([0.0, due_m_s * interval_s] + 6 * [0.0])


def test_a_cloud_where_nothing_was_seen_before_is_refused():
    away = {4: lambda T: T @ se3.exp(np.array([0.0, 0.0, 4.0, 0.0, 0.0, 0.0]))}
    found, _ = driven(away, speed_max_m_s=1e3, overlap_min_ratio=0.5)
    assert found[4].status is TrackingStatus.DEGRADED and found[4].inliers == 0


def test_a_direction_that_the_cloud_leaves_open_follows_the_prediction():
    slip = {index: lambda T: T @ se3.from_xy_yaw(0.05, 0.0, 0.0) for index in range(1, 8)}
    weak, _ = driven(slip, odometry=False, weak_ratio=0.5)
    held, _ = driven(slip, odometry=False)
    assert {one.status for one in weak} == {TrackingStatus.DEGRADED}
    assert np.linalg.norm(weak[-1].T_local_base[:3, 3]) < 0.05
    assert np.linalg.norm(held[-1].T_local_base[:3, 3]) > 0.3
    assert np.trace(weak[-1].covariance) > np.trace(held[-1].covariance)


def test_a_direction_that_surfaces_face_less_follows_the_wheels_more():
    """Both slide as far; of x a tenth is held, y is held in full."""
    x, y = (0.01, 0.0), (0.0, 0.01)
    off_m, deviation_m = [], []
    for axis, along in enumerate((x, y)):
        slip = {
            index: lambda T, along=along: T @ se3.from_xy_yaw(*along, 0.0) for index in range(1, 8)
        }
        found, _ = driven(slip)
        T_true = se3.inverse(room_observation(0).T_odom_base) @ room_observation(7).T_odom_base
        off_m.append(abs((se3.inverse(T_true) @ found[7].T_local_base)[axis, 3]))
        deviation_m.append(np.sqrt(found[7].covariance[axis, axis]))
    assert off_m[0] < 0.5 * off_m[1] and deviation_m[0] > 1.2 * deviation_m[1]


@pytest.mark.parametrize(
    ("key", "value"), [("noise_m", 0.0), ("overlap_min_ratio", 1.1), ("weak_ratio", -0.1)]
)
def test_a_setting_that_makes_no_sense_is_named(key, value):
    with pytest.raises(ConfigError, match=key):
        Around(**(SETTINGS | {key: value}))


def test_a_library_that_is_missing_is_named(monkeypatch):
    monkeypatch.setattr(Around, "library", "no_such_library")
    with pytest.raises(ConfigError, match=r"pip install 'sceneslam\[no_such_library\]'"):
        Around(**SETTINGS)


def test_quiet_drops_standard_output_and_gives_it_back(capfd):
    with quiet():
        os.write(1, b"a page of status")
    os.write(1, b"kept")
    assert capfd.readouterr().out == "kept"


@pytest.fixture
def rko(monkeypatch):
    """Return the calls of a stand-in for the library, which is not installed everywhere."""
    calls = {"imu_ns": [], "scans_ns": []}

    class LIO:
        def __init__(self, config):
            pass

        def add_imu_measurement(self, force, rate, time_ns, T_base_imu):
            calls["imu_ns"].append(time_ns)

        def register_scan(self, points, stamps_ns, T_base_lidar):
            calls["scans_ns"].append(stamps_ns)

        def pose(self):
            return np.eye(4)

        def map_point_cloud(self):
            return np.zeros((0, 3))

    parts = {
        "rko_lio": {"__spec__": ModuleSpec("rko_lio", None)},
        "rko_lio.config": {"LIOConfig": lambda **settings: settings},
        "rko_lio.lio": {"LIO": LIO},
        "rko_lio.rko_lio_pybind": {"InputError": RuntimeError},
    }
    for name, members in parts.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    return calls


def inertial(index):
    """Return ten samples of gyro and accelerometer since the observation before."""
    times_s = np.linspace(-0.03, 0.0, 10)
    samples = np.column_stack([times_s, np.zeros((10, 2)), np.full(10, 9.8)])
    return replace(room_observation(index), gyro_base=samples, accelerometer_base=samples)


def lio():
    names = ("depth_range_max_m", "depth_stride_px")
    settings = {name: value for name, value in SETTINGS.items() if name not in names}
    module = RkoLio(**settings, correspondence_max_m=None, is_at_rest_first=True)
    module.activate(RIG)
    return module


def test_imu_samples_of_observations_without_a_cloud_are_used(rko):
    module = lio()
    for index in range(6):
        silent = {} if index % 3 == 0 else {"points_lidar": None}
        module.track(replace(inertial(index), **silent))
    assert len(rko["scans_ns"]) == 2
    assert len(rko["imu_ns"]) == 60 and (np.diff(rko["imu_ns"]) > 0).all()


def test_points_without_a_valid_time_have_the_stamp_of_their_cloud(rko):
    observation = inertial(0)
    times_s = np.full(len(observation.points_lidar), -0.05)
    times_s[:3] = np.nan, np.inf, -np.inf
    lio().track(replace(observation, point_times_s=times_s))
    (stamps_ns,) = rko["scans_ns"]
    after_ns = [0, 0, 0] + [-50_000_000] * (len(times_s) - 3)
    assert (stamps_ns - observation.stamp_ns).tolist() == after_ns


def test_gyro_without_a_sample_of_the_accelerometer_is_not_used(rko):
    lio().track(replace(inertial(0), accelerometer_base=np.zeros((0, 4))))
    assert len(rko["scans_ns"]) == 1 and not rko["imu_ns"]
