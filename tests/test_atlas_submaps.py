"""What a run is cut into: steps, submaps, and the uncertain motions between them."""

from dataclasses import replace

import numpy as np
import pytest

from sceneslam.atlas.submaps.collector import Collector, Known
from sceneslam.atlas.submaps.submap import KeyPose, OpenSubmap, make_submap, motion_covariance
from sceneslam.atlas.uncertainty import MAPPED, VELOCITY, drifted, of_wheels
from sceneslam.graphs.edge import EdgeKind
from sceneslam.types import planar, se3
from sceneslam.types.rig import Rig, Sensor, Wheels
from sceneslam.types.run import BRIDGED

S = 10**9
WHEELS, POOR = of_wheels(Wheels()), Wheels(drift_ratio=0.1, drift_rad_per_m=0.03)
RIG = Rig(sensors=frozenset({Sensor.ODOMETRY}))


def pose_at(T_map_base):
    return Known(T_map_base=T_map_base, session=0, module="a", covariance=None)


def at(x_m=0.0, y_m=0.0, yaw_rad=0.0):
    return se3.from_xy_yaw(x_m, y_m, yaw_rad)


def pitched(x_m, z_m=0.0, pitch_rad=0.0):
    T = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, pitch_rad, 0.0]))
    T[:3, 3] = x_m, 0.0, z_m
    return T


# The covariance of a motion.


@pytest.mark.parametrize("drift", [WHEELS, VELOCITY, MAPPED])
@pytest.mark.parametrize(("way_m", "turn_rad"), [(2.0, 0.0), (0.0, 0.5), (2.0, 0.5)])
def test_a_motion_drifts_as_its_kind(drift, way_m, turn_rad):
    systematic = drift.rad_per_m * way_m + drift.rad_per_rad * turn_rad
    turn2 = systematic**2 + drift.rad_per_root**2 * (way_m + turn_rad)
    shift2 = (drift.per_m * way_m) ** 2 + turn2 * (0.5 * way_m) ** 2
    expected = np.diag(np.repeat([shift2, turn2], 3))
    np.testing.assert_allclose(drifted(drift, np.array([way_m, turn_rad])), expected, atol=1e-15)


def key_pose(index, T_map_base, *, session=0, drift=MAPPED, reported=None):
    return KeyPose(
        stamp_ns=index * S,
        scan=None,
        T_map_base=T_map_base,
        session=session,
        module="a",
        drift=drift,
        reported=reported,
    )


@pytest.mark.parametrize("drift", [MAPPED, WHEELS, VELOCITY])
def test_the_motion_between_two_submaps_is_as_uncertain_as_its_drift(drift):
    places = [at(), at(1.0, 0.0, 0.1), at(2.0, 0.0, -0.1)]
    poses = [key_pose(index, T, drift=drift) for index, T in enumerate(places)]
    systematic = drift.rad_per_m * 2.0 + drift.rad_per_rad * 0.3
    turn = np.hypot(systematic, drift.rad_per_root * np.sqrt(2.3))
    shift = np.hypot(drift.per_m * 2.0, turn * 1.0)  # half of the 2 m between the ends
    expected = np.repeat([shift**2 + 0.003**2, turn**2 + 0.002**2], 3)
    np.testing.assert_allclose(motion_covariance(poses), np.diag(expected))


def test_what_a_module_reports_adds_its_growth_within_one_session():
    reported = (1e-4 * np.eye(6), 3e-4 * np.eye(6))
    first, last = (key_pose(i, at(), reported=one) for i, one in enumerate(reported))
    least = np.repeat([0.003**2, 0.002**2], 3)
    np.testing.assert_allclose(motion_covariance([first, last]), np.diag(least + 2e-4))
    np.testing.assert_allclose(motion_covariance([last, first]), np.diag(least), atol=1e-15)
    other = replace(last, session=1)
    np.testing.assert_allclose(motion_covariance([first, other]), np.diag(least))


# Steps and submaps.


def unseen(*_):
    """Locate nothing in a view."""


def collector(known=lambda stamp_ns: None, rig=RIG):
    return Collector(rig, known, 0, unseen)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_step_is_a_tenth_of_a_metre_or_of_a_radian(sign):
    own = collector()
    assert own.has_moved(pose_at(at()))
    own.step_to(at())
    for little, enough in (
        (at(sign * 0.099), at(sign * 0.101)),
        (at(0.0, sign * 0.099), at(0.0, sign * 0.101)),
        (at(0.0, 0.0, sign * 0.099), at(0.0, 0.0, sign * 0.101)),
    ):
        assert not own.has_moved(pose_at(little)) and own.has_moved(pose_at(enough))


def test_a_pose_is_level_up_to_three_degrees_and_a_slope_of_one_in_five():
    def is_level_after(T, steps=100):
        own = collector()
        assert all(own.step_to(at(0.1 * index)) for index in range(steps))
        return own.step_to(T)

    for sign in (1.0, -1.0):
        assert is_level_after(pitched(10.0, pitch_rad=sign * np.radians(2.9)))
        assert not is_level_after(pitched(10.0, pitch_rad=sign * np.radians(3.2)))
        assert is_level_after(pitched(9.9 + 0.5, z_m=sign * 0.099))
        assert not is_level_after(pitched(9.9 + 0.5, z_m=sign * 0.101))
        assert is_level_after(pitched(9.9, z_m=sign * 0.0199))  # of a step at least
        assert not is_level_after(pitched(9.9, z_m=sign * 0.0201))


def test_a_base_whose_steps_are_mostly_level_moves_on_a_floor():
    own = collector()
    for index in range(10):
        own.step_to(pitched(0.1 * index, z_m=0.5 * (index % 2) * (index < 6)))
    assert not own.is_level  # 4 of 10
    for index in range(10, 12):
        own.step_to(pitched(0.1 * index))
    assert own.is_level  # 6 of 12


def split(poses):
    """Group poses into submaps, each of which takes as many as it can."""
    parts = [OpenSubmap()]
    for pose in poses:
        if not parts[-1].take(pose):
            parts.append(OpenSubmap())
            assert parts[-1].take(pose)
    return [part.poses for part in parts]


def test_a_submap_ends_after_its_length_its_turn_and_its_session():
    ahead = [key_pose(index, at(0.25 * index)) for index in range(25)]
    assert [len(part) for part in split(ahead)] == [11, 11, 3]
    turning = [key_pose(index, at(0.0, 0.0, 0.5 * index)) for index in range(30)]
    assert [len(part) for part in split(turning)] == [13, 13, 4]
    two = [key_pose(index, at(), session=index // 4) for index in range(6)]
    assert [len(part) for part in split(two)] == [4, 2]
    third = make_submap(split(ahead)[1], 3, se3.identity())
    assert (third.run, third.session, third.module) == (3, 0, "a")
    np.testing.assert_allclose(third.T_submap_base[-1], [2.5, 0.0, 0.0], atol=1e-12)
    assert third.stamps_ns[0] == 11 * S


@pytest.mark.parametrize("roll_rad", [0.0, 0.3])
@pytest.mark.parametrize("pitch_rad", [0.0, 0.3])
def test_a_submap_is_level_in_the_plane_however_its_first_pose_is_tilted(pitch_rad, roll_rad):
    begun = at(1.0, 2.0, 0.5)
    rolled = se3.exp(np.array([0.0, 0.0, 0.0, roll_rad, 0.0, 0.0]))
    tilted = begun @ pitched(0.0, pitch_rad=pitch_rad) @ rolled
    poses = [tilted, *(begun @ at(0.2 * k, 0.1, 0.3) for k in range(1, 10))]
    own = make_submap([key_pose(k, T) for k, T in enumerate(poses)], 0, se3.identity())
    due = [[0.2 * k, 0.1, 0.3] for k in range(1, 10)]
    np.testing.assert_allclose(own.T_submap_base, [[0.0, 0.0, 0.0], *due], atol=1e-9)


def test_a_climb_is_as_long_as_a_way_ahead():
    def up(z_m):
        T = se3.identity()
        T[2, 3] = z_m
        return T

    climbs = [key_pose(index, up(0.25 * index)) for index in range(25)]
    assert [len(part) for part in split(climbs)] == [11, 11, 3]
    ahead = [key_pose(index, at(0.25 * index)) for index in range(25)]
    np.testing.assert_allclose(motion_covariance(climbs), motion_covariance(ahead))


def run_of(count, *, module=lambda i: "a", session=lambda i: 0, step_s=1):
    """Return a collector after so many steps of 0.5 m, one a second."""

    def known(stamp_ns):
        index = stamp_ns // (step_s * S)
        return Known(
            T_map_base=at(0.5 * index),
            session=session(index),
            module=module(index),
            covariance=None,
        )

    own = collector(known)
    for index in range(count):
        own.step_to(at(0.5 * index))
        own.add(index * step_s * S, None)
    return own


def test_a_submap_is_complete_as_soon_as_the_next_step_is_beyond_it():
    assert [len(run_of(count).chain) for count in (6, 7, 12, 13)] == [0, 1, 1, 2]
    own = run_of(41)
    assert [len(one.stamps_ns) for one in own.chain.submaps] == [6] * 6
    assert own.chain.submaps[-1].stamps_ns[-1] == 35 * S
    own.finish()
    assert [len(one.stamps_ns) for one in own.chain.submaps] == [6] * 6 + [5]
    node_at = own.chain.node_at
    assert node_at(0) == 0 and node_at(-5) == 0
    assert [node_at(index * S) for index in (5, 6, 35, 36, 99)] == [0, 1, 5, 6, 6]


def test_motions_lead_from_submap_to_submap_and_their_deviations_add_up():
    own = run_of(12)
    own.finish()
    (motion,) = own.chain.motions
    assert (motion.first, motion.second, motion.kind) == (0, 1, EdgeKind.MOTION)
    np.testing.assert_allclose(motion.T_first_second, at(3.0), atol=1e-12)
    np.testing.assert_array_equal(own.chain.drift[0], np.zeros((2, 3)))
    turn2 = 0.003**2 * 2.5  # of a map's motion over a submap, whose errors correlate
    shift2 = 0.0125**2 + turn2 * 1.25**2
    told = np.array([shift2 + 0.003**2, shift2 + 0.003**2, turn2 + 0.002**2])
    variances = np.diag(planar.planar_covariance(motion.covariance))
    expected = variances + 3.0 * np.minimum(variances, told)
    np.testing.assert_allclose(own.chain.drift[1], [np.zeros(3), expected], rtol=1e-9)
    own.chain.remeasure(lambda stamp_ns: at(1.0 + 2 / 3 * stamp_ns / S))
    np.testing.assert_allclose(own.chain.motions[0].T_first_second, at(4.0), atol=1e-12)


@pytest.mark.parametrize(
    ("bridged", "kind"), [({1, 2, 3}, EdgeKind.MOTION), ({1, 2, 3, 4}, EdgeKind.BRIDGE)]
)
def test_a_motion_that_is_bridged_for_more_than_half_is_a_bridge(bridged, kind):
    own = run_of(7, module=lambda i: BRIDGED if i in bridged else "a")
    own.finish()
    assert own.chain.motions[0].kind is kind
    other = run_of(8, session=lambda i: i // 4)
    other.finish()
    assert [edge.kind for edge in other.chain.motions] == [EdgeKind.HANDOVER]


@pytest.mark.parametrize(
    ("sensors", "wheels", "drift"),
    [
        ({Sensor.ODOMETRY}, Wheels(), WHEELS),
        ({Sensor.ODOMETRY}, POOR, of_wheels(POOR)),
        ({Sensor.ODOMETRY, Sensor.GYRO}, POOR, of_wheels(POOR, has_gyro=True)),
        ({Sensor.GYRO}, Wheels(), VELOCITY),
        (set(), Wheels(), VELOCITY),
    ],
)
def test_a_bridge_drifts_as_the_sensors_that_measured_it(sensors, wheels, drift):
    def known(stamp_ns):
        index = stamp_ns // S
        return Known(T_map_base=at(0.5 * index), session=0, module=BRIDGED, covariance=None)

    own = collector(known, Rig(sensors=frozenset(sensors), wheels=wheels))
    for index in range(12):
        own.add(index * S, None)
    own.finish()
    (motion,) = own.chain.motions
    poses = [key_pose(index, at(0.5 * index), drift=drift) for index in range(7)]
    np.testing.assert_allclose(motion.covariance, motion_covariance(poses))
