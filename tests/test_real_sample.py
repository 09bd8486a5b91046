"""The real recordings that come with the tests: what modules and detector make of real sensors.

A bound is twice what was measured.
"""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hydra.utils import get_class
from ros_recordings import make_source

from sceneslam.evaluation.accuracy import absolute_errors, rotation_rmse_rad
from sceneslam.evaluation.relations import Relations, relation_errors
from sceneslam.types.observation import TrackingStatus
from sceneslam.types.trajectory import Trajectory

DATA = Path(__file__).parent / "data"
TUM, INTEL = DATA / "tum_freiburg1_rpy", DATA / "carmen_intel"
KINECT = {  # freiburg1's, halved
    "fx": 258.65,
    "fy": 258.25,
    "cx": 159.05,
    "cy": 127.4,
    "distortion": [0.2624, -0.9531, -0.0054, 0.0026, 1.1633],
}


def make_module(name, **changes):
    conf = Path(__file__).parents[1] / "conf" / "slam" / f"{name}.yaml"
    settings = yaml.safe_load(conf.read_text()) | changes
    return get_class(settings.pop("_target_"))(**settings)


def tracked(module, source):
    """Return the trajectory that a module reports, and how it called its poses."""
    module.activate(source.rig)
    answers = [module.track(observation) for observation in source]
    module.shutdown()
    poses = Trajectory(
        stamps_ns=np.array([one.stamp_ns for one in answers]),
        T_world_base=np.array([one.T_local_base for one in answers]),
    )
    return poses, {one.status for one in answers}


@pytest.mark.parametrize(
    ("name", "changes", "limit_m", "limit_rad"),
    [("rgbd", {"seed": 0, "is_repeatable": True}, 0.032, 0.047), ("depth", {}, 0.040, 0.066)],
)
def test_a_kinect_held_by_hand_is_tracked(name, changes, limit_m, limit_rad):
    source = make_source("tum_rgbd", TUM, camera=KINECT)
    estimate, statuses = tracked(make_module(name, **changes), source)
    truth = source.ground_truth().trajectory
    errors = absolute_errors(estimate, truth, 0.01)
    assert statuses == {TrackingStatus.TRACKING} and len(errors.errors_m) == 45
    assert errors.rmse_m < limit_m
    assert rotation_rmse_rad(estimate, truth, 0.01) < limit_rad


def test_a_laser_in_real_corridors_is_tracked_far_better_than_by_wheels():
    source = make_source("carmen", INTEL / "intel_part.clf")
    estimate, statuses = tracked(make_module("laser"), source)
    assert TrackingStatus.LOST not in statuses
    observations = list(source)
    wheels = Trajectory(
        stamps_ns=estimate.stamps_ns,
        T_world_base=np.array([one.T_odom_base for one in observations]),
    )
    relations = Relations.read(INTEL / "intel_part.relations")
    logged_ns = source.logged_ns(estimate.stamps_ns)
    laser, odometry = (
        relation_errors(one.stamped(logged_ns), relations) for one in (estimate, wheels)
    )
    assert laser["matched"] == 66
    assert laser["trans_mean_m"] < 0.025 and laser["rot_mean_deg"] < 0.64
    assert laser["trans_mean_m"] < 0.17 * odometry["trans_mean_m"]


def test_a_lit_office_is_called_bright():
    source = make_source("tum_rgbd", TUM, camera=KINECT)
    conf = Path(__file__).parents[1] / "conf" / "detector" / "grey_mean.yaml"
    settings = yaml.safe_load(conf.read_text())
    detector = get_class(settings.pop("_target_"))(**settings)
    assert {detector.get_scene(observation).scene for observation in source} == {"Bright"}


def test_every_recording_names_its_licence():
    page = (DATA / "README.md").read_text()
    folders = [path.name for path in DATA.iterdir() if path.is_dir()]
    assert {f"## {name}" for name in folders} <= set(page.splitlines())
    assert page.count("Licence: Creative Commons Attribution") == len(folders)
    assert sum(path.stat().st_size for path in DATA.rglob("*") if path.is_file()) < 3_000_000
