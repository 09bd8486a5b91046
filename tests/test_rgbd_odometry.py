"""What wheel odometry gives the RGB-D module: a way on where its map ends."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from hydra.utils import instantiate
from omegaconf import OmegaConf

from sceneslam.testing.room import RIG, observation_at, room_observation
from sceneslam.types import se3
from sceneslam.types.observation import TrackingStatus

YAML = Path(__file__).parents[1] / "conf" / "slam" / "rgbd.yaml"


def drive_away_in_the_dark(*, without_odometry=()):
    """See one wall, turn round in the dark, and see another; return the answers.

    `without_odometry`: the observations that miss it.
    """
    config = OmegaConf.merge(
        {"seed": 0, "run": {"is_repeatable": True}}, {"node": OmegaConf.load(YAML)}
    ).node
    module = instantiate(config, _convert_="all")
    module.activate(RIG)
    observations = [room_observation(index) for index in range(6)]
    start = observations[-1].T_odom_base
    for step in range(1, 11):
        seen = observation_at(start @ se3.from_xy_yaw(0, 0, 0.2 * step), (5 + step) / 30)
        observations.append(replace(seen, image_bgr=np.zeros_like(seen.image_bgr)))
    turned = start @ se3.from_xy_yaw(0, 0, 2.0)
    for step in range(8):
        there = turned @ se3.from_xy_yaw(0.01 * step, 0, 0)
        observations.append(observation_at(there, (16 + step) / 30))
    observations = [replace(o, gyro_base=None) for o in observations]  # it knows no such turn
    for index in without_odometry:
        observations[index] = replace(observations[index], T_odom_base=None)
    answers = [module.track(observation) for observation in observations]
    return answers, turned, module.get_map().pose_graph


def test_new_place_is_hung_on_odometry_after_it_was_looked_for_in_the_map():
    answers, turned, _ = drive_away_in_the_dark()
    assert {answer.status for answer in answers[6:16]} == {TrackingStatus.LOST}
    assert {answer.status for answer in answers[16:19]} == {TrackingStatus.LOST}
    assert answers[19].status is TrackingStatus.DEGRADED
    wheels_rad = np.sqrt(answers[19].covariance[5, 5])  # after 2 rad in the dark
    assert wheels_rad > 10.0 * np.sqrt(answers[5].covariance[5, 5])
    assert answers[-1].status is TrackingStatus.TRACKING
    first = room_observation(0).T_odom_base
    truth = se3.inverse(first) @ turned @ se3.from_xy_yaw(0.07, 0, 0)
    error = se3.inverse(truth) @ answers[-1].T_local_base
    assert np.linalg.norm(error[:3, 3]) < 0.05 and se3.rotation_angle_rad(error) < 0.03


def test_new_place_is_as_uncertain_as_the_drive_to_it_after_odometry_with_a_gap():
    answers, _, graph = drive_away_in_the_dark(without_odometry=[3])
    assert answers[3].status is answers[5].status is TrackingStatus.TRACKING
    assert graph.edges[0].tolist() == [0, 1]
    covariance = np.linalg.inv(graph.information[0])
    np.testing.assert_allclose(covariance, answers[19].covariance, atol=1e-9)
    assert np.sqrt(covariance[5, 5]) > 0.06  # after 2 rad


def test_new_place_stays_lost_without_odometry():
    answers, _, _ = drive_away_in_the_dark(without_odometry=range(24))
    assert {answer.status for answer in answers[6:]} == {TrackingStatus.LOST}
