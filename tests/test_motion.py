"""The one motion model: what it predicts, learns, and whom it believes."""

import numpy as np
import pytest

from sceneslam.motion.model import MotionModel
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Gyro, Rig, Sensor, Wheels

PERIOD_S = 0.1
SCAN = np.diag([0.004, 0.004, 1e-4, 1e-4, 1e-4, 0.002]) ** 2  # of a scan's motion
WHEELED = Rig(sensors=frozenset({Sensor.ODOMETRY, Sensor.SCAN}))
FREE = Rig(sensors=frozenset({Sensor.DEPTH}))


class Drive:
    """A robot that drives, its wheels, and a model that scans teach."""

    def __init__(self, *, noise=0.005, seed=0, rig=WHEELED, period_s=PERIOD_S):
        self.rng = np.random.default_rng(seed)
        self.model = MotionModel(rig)
        self.noise, self.period_s = noise, period_s
        self.stamp_ns, self.T_odom_base = 0, se3.from_xy_yaw(3.0, -1.0, 2.0)
        self.model.predict(self.observation())

    def observation(self, gyro=None):
        return Observation(stamp_ns=self.stamp_ns, T_odom_base=self.T_odom_base, gyro_base=gyro)

    def step(self, speed=0.5, rate=0.2, *, factor=1.0, pull=0.0, gyro=None, teaches=True):
        """Drive one step; return the prediction's error in the direction of driving [m]."""
        forward_m, turn_rad = speed * self.period_s, rate * self.period_s
        T_true = se3.from_xy_yaw(forward_m, 0.0, turn_rad)
        wheels = np.array([factor * forward_m, 0.0, turn_rad + pull * forward_m])
        amounts = np.array([forward_m, forward_m, turn_rad])
        wheels += self.noise * np.sqrt(np.abs(amounts)) * self.rng.standard_normal(3)
        self.T_odom_base = self.T_odom_base @ se3.from_xy_yaw(*wheels)
        self.stamp_ns += round(self.period_s * 1e9)
        motion = self.model.predict(self.observation(gyro))
        if teaches:
            seen = np.sqrt(np.diag(SCAN)) * self.rng.standard_normal(6)
            self.model.learn(T_true @ se3.exp(seen), SCAN)
        self.last = motion
        return abs(float(motion.T_prev_curr[0, 3]) - forward_m)


def constant_rate(rate_radps, bias_radps=0.0):
    times_s = np.linspace(-0.09, 0.0, 10)
    rates = np.zeros((10, 3))
    rates[:, 2] = rate_radps
    return np.column_stack([times_s, rates + bias_radps])


def test_wheels_give_the_motion_and_a_covariance_that_grows_with_it():
    drive = Drive(noise=0.0)
    near_m = drive.step(speed=0.2, teaches=False)
    near = drive.last.covariance
    far_m = drive.step(speed=2.0, teaches=False)
    assert max(near_m, far_m) < 1e-9
    assert drive.last.is_measured
    assert drive.last.covariance[0, 0] > 4.0 * near[0, 0]


def test_covariance_of_a_way_does_not_depend_on_how_often_it_is_told():
    deviations_m = []
    for count in (5, 100):
        drive = Drive(noise=0.0)
        steps = []
        for _ in range(count):
            drive.step(speed=1.0 / count / PERIOD_S, rate=0.0, teaches=False)
            steps.append(drive.last.covariance[0, 0])
        deviations_m.append(np.sqrt(sum(steps)))
    assert deviations_m == pytest.approx([WHEELED.wheels.noise_ratio] * 2, rel=0.01)


@pytest.mark.parametrize("noise", [0.04, 0.3])
def test_noise_of_the_wheels_is_learnt_in_either_direction(noise):
    for channel, speed, rate in ((0, 1.0, 0.0), (1, 0.0, 1.0)):
        drive = Drive(noise=noise)
        for _ in range(400):
            drive.step(speed=2.0 * speed, rate=2.0 * rate)
        assert drive.model.noise_ratios[channel] == pytest.approx(noise, rel=0.5)


def test_lie_of_some_seconds_does_not_spoil_what_was_learnt():
    drive = Drive()
    for _ in range(300):
        drive.step()
    before = drive.model.noise_ratios
    for _ in range(50):
        drive.step(factor=-1.0)
    assert drive.model.noise_ratios == pytest.approx(before, rel=0.3)


@pytest.mark.parametrize("noise", [0.02, 0.07])
@pytest.mark.parametrize("period_s", [1 / 30, 0.1])
def test_noise_is_no_lie(noise, period_s):
    drive = Drive(noise=noise, period_s=period_s)
    doubted = []
    for index in range(round(40.0 / period_s)):
        drive.step(speed=0.6 + 0.4 * np.sin(index * period_s))
        doubted.append(drive.last.is_doubted)
    assert np.mean(doubted) < 0.02


def test_odometry_that_is_missing_once_is_no_lie():
    drive = Drive()
    for _ in range(100):
        drive.step()
    before = drive.model.lying
    drive.stamp_ns += round(PERIOD_S * 1e9)
    drive.model.predict(Observation(stamp_ns=drive.stamp_ns))
    drive.model.learn(se3.from_xy_yaw(0.05, 0.0, 0.02), SCAN)
    assert drive.model.lying == pytest.approx(before, abs=0.01)


def test_lies_are_found_though_learning_is_often_interrupted():
    drive = Drive(period_s=1 / 30)
    for index in range(300):
        drive.step(factor=1.0 if index < 150 else 0.0, teaches=index % 3 > 0)
        if index % 3 == 0:
            drive.model.skip()
    assert drive.model.lying[0] > 0.9


def test_noise_between_poses_hides_no_lie():
    drive, T_true, T_seen = Drive(period_s=1 / 30), se3.identity(), se3.identity()
    deviation = np.array([0.01] * 3 + [0.005] * 3)
    for index in range(180):
        drive.step(speed=1.0, factor=1.0 if index < 90 else 2.0, teaches=False)
        T_true = T_true @ se3.from_xy_yaw(1.0 / 30, 0.0, 0.2 / 30)
        T_before, T_seen = T_seen, T_true @ se3.exp(deviation * drive.rng.standard_normal(6))
        drive.model.learn(se3.inverse(T_before) @ T_seen, 2.0 * np.diag(deviation**2))
        if index == 89:
            assert drive.model.lying[0] < 0.05
    assert drive.model.lying[0] > 0.9


@pytest.mark.parametrize("period_s", [1 / 30, 0.1])
@pytest.mark.parametrize(("speed", "noise_m"), [(0.1, 0.003), (0.2, 0.01)])
def test_slow_lies_are_found_though_noise_hides_them_in_each_image(speed, noise_m, period_s):
    drive, T_true, T_seen = Drive(period_s=period_s), se3.identity(), se3.identity()
    deviation, fault = np.full(6, noise_m), round(4.0 / period_s)
    for index in range(2 * fault):
        factor = 1.0 if index < fault else 0.0
        drive.step(speed=speed, rate=0.0, factor=factor, teaches=False)
        T_true = T_true @ se3.from_xy_yaw(speed * period_s, 0.0, 0.0)
        T_before, T_seen = T_seen, T_true @ se3.exp(deviation * drive.rng.standard_normal(6))
        drive.model.learn(se3.inverse(T_before) @ T_seen, 2.0 * np.diag(deviation**2))
        if index == fault - 1:
            assert drive.model.lying[0] < 0.05
    assert drive.model.lying[0] > 0.9


@pytest.mark.parametrize("factor", [-1.0, 0.0, 2.0])
def test_lying_wheels_are_found_out_and_believed_again(factor):
    drive = Drive()
    for _ in range(100):
        drive.step()
    missed_m = [drive.step(factor=factor) for _ in range(50)]
    assert drive.last.is_doubted
    assert max(missed_m[6:]) < 0.02  # by the wheels 0.05 and more
    for _ in range(20):
        drive.step()
    assert not drive.last.is_doubted


def test_lie_about_the_distance_leaves_the_turn_to_the_wheels():
    drive = Drive()
    for _ in range(100):
        drive.step()
    for index in range(20):
        drive.step(factor=-1.0, rate=0.2 + 0.5 * np.sin(index))
    distance, turn = drive.model.lying
    assert distance > 0.9
    assert turn < 0.2
    turned_rad = se3.yaw_rad(drive.last.T_prev_curr)
    assert turned_rad == pytest.approx((0.2 + 0.5 * np.sin(19)) * PERIOD_S, abs=0.01)


def test_alternatives_are_distance_and_turn_by_the_sources_that_are_not_used():
    drive = Drive()
    for _ in range(100):
        drive.step()
    drive.step(factor=-1.0, rate=-0.5)
    motions = (drive.last, *drive.last.alternatives)
    distances_m = [motion.T_prev_curr[0, 3] for motion in motions]
    assert distances_m == pytest.approx([-0.05] * 2 + [0.05] * 4, abs=0.01)
    is_guessed = [(distance, turn) for distance in (False, True, True) for turn in (False, True)]
    assert [motion.is_guessed for motion in motions] == is_guessed
    by_inertia, anywhere = (motions[k].covariance[0, 0] for k in (2, 4))
    assert anywhere > by_inertia
    assert not drive.last.is_doubted


def test_evidence_is_how_much_more_likely_a_measurement_made_wrong_wheels():
    drive = Drive()
    for _ in range(100):
        drive.step()
    before = np.array([one.probability for one in (drive.last, *drive.last.alternatives)])
    assert drive.last.evidence(before / before.sum()) == pytest.approx([0.0, 0.0])
    is_wrong = [one.is_guessed[0] for one in (drive.last, *drive.last.alternatives)]
    distance, turn = drive.last.evidence(np.where(is_wrong, 10.0 * before, before))
    assert distance == pytest.approx(np.log(10.0))
    assert turn < distance


@pytest.mark.parametrize(("speed", "is_possible"), [(0.6, True), (-0.5, False)])
def test_inertia_contradicts_wheels_that_reverse_between_two_observations(speed, is_possible):
    drive = Drive()
    for _ in range(100):
        drive.step()
    drive.model.learn(np.eye(4), SCAN, np.zeros(2))
    for _ in range(3):
        drive.step(speed=speed, teaches=False)
    assert (drive.model.lying[0] < 0.1) == is_possible


def test_inertia_does_not_contradict_wheels_once_the_velocity_is_old():
    drive = Drive()
    for _ in range(100):
        drive.step()
    drive.model.learn(np.eye(4), SCAN, np.zeros(2))
    for _ in range(30):
        drive.step(teaches=False)
    for _ in range(10):
        drive.step(speed=0.0, rate=0.0, teaches=False)
    assert drive.model.lying.max() < 0.1


def test_what_no_scan_sees_teaches_nothing():
    drive = Drive()
    for _ in range(100):
        drive.step()
    before, blind = drive.model.noise_ratios, SCAN + np.diag([1e2, 1e2, 0, 0, 0, 0])
    for _ in range(30):
        drive.step(factor=-1.0, teaches=False)
        drive.model.learn(se3.from_xy_yaw(0.05, 0.0, 0.02), blind)
    assert drive.model.noise_ratios[0] == pytest.approx(before[0], rel=0.05)


@pytest.mark.parametrize("scale", [0.96, 1.03])
def test_scale_of_the_wheels_is_learnt(scale):
    drive = Drive()
    for _ in range(400):
        drive.step(factor=scale)
    drive.noise = 0.0
    missed_m = drive.step(speed=10.0, rate=0.0, factor=scale, teaches=False)  # of 1 m
    assert missed_m < 0.006


def test_wheels_that_pull_to_one_side_are_corrected():
    drive = Drive()
    for _ in range(300):
        drive.step(pull=0.1, rate=0.0)
    drive.step(pull=0.1, rate=0.0)
    assert abs(se3.yaw_rad(drive.last.T_prev_curr)) < 0.001  # 0.005 by the wheels


def test_base_ahead_of_the_axle_is_moved_sideways_by_a_turn():
    drive = Drive(rig=Rig(sensors=WHEELED.sensors, wheels=Wheels(axle_m=0.05)))
    T_axle_base = se3.from_xy_yaw(0.1, 0.0, 0.0)
    missed_m = []
    for number in range(200):
        T_axle = se3.from_xy_yaw(0.02, 0.0, 0.1 * (-1) ** (number // 20))
        drive.T_odom_base = drive.T_odom_base @ T_axle
        drive.stamp_ns += round(PERIOD_S * 1e9)
        motion = drive.model.predict(drive.observation())
        T_true = se3.inverse(T_axle_base) @ T_axle @ T_axle_base
        missed_m.append(abs(motion.T_prev_curr[1, 3] - T_true[1, 3]))
        drive.model.learn(T_true, SCAN)
    assert missed_m[0] > 0.009
    assert max(missed_m[100:]) < 0.001


def test_turns_about_axes_that_change_are_no_sum_of_rates():
    """As of a camera in the hand; the sum is off by 0.018 rad."""
    times_s = np.arange(-59, 1) * 0.005
    rates = np.column_stack([1.5 * np.sin(6 * times_s), 1.5 * np.cos(6 * times_s), 0.0 * times_s])
    gyro = np.column_stack([times_s, rates])
    turned = Observation(stamp_ns=0, gyro_base=gyro).turn_by_gyro(0.295)
    steps = se3.so3_exp(0.0025 * (rates[1:] + rates[:-1]))
    truth = se3.so3_log(np.linalg.multi_dot(list(steps)))
    np.testing.assert_allclose(turned, truth, atol=2e-3)
    assert np.linalg.norm(np.trapezoid(rates, times_s, axis=0) - truth) > 0.015


def test_gyro_turns_the_base_without_its_bias():
    drive = Drive()
    for _ in range(200):  # at rest: nobody teaches
        drive.step(speed=0.0, rate=0.0, gyro=constant_rate(0.0, 0.01), teaches=False)
    assert drive.model.turns.gyro_bias == pytest.approx([0.01] * 3, abs=0.001)
    drive.step(speed=0.0, rate=0.0, gyro=constant_rate(0.5, 0.01), teaches=False)  # wheels slip
    assert se3.yaw_rad(drive.last.T_prev_curr) == pytest.approx(0.05, abs=2e-4)


@pytest.mark.parametrize("parts", [1, 20])
def test_what_is_left_of_a_gyros_bias_adds_up_until_a_motion_is_measured(parts):
    model, turned_rad2, period_s = MotionModel(FREE), 0.0, 1.0 / parts
    bias_radps, noise_rad2 = model.turns.gyro_bias_deviation, Gyro().noise_rad ** 2
    times_s = np.linspace(-0.99 * period_s, 0.0, 100)
    for part in range(parts + 1):
        gyro = np.column_stack([times_s, np.zeros((100, 3))])
        stamp_ns = round(part * period_s * 1e9)
        motion = model.predict(Observation(stamp_ns=stamp_ns, gyro_base=gyro))
        turned_rad2 += motion.covariance[5, 5]
    assert turned_rad2 == pytest.approx(bias_radps**2 + parts * noise_rad2)
    model.learn(se3.identity(), SCAN)
    after = model.predict(Observation(stamp_ns=round((1.0 + period_s) * 1e9), gyro_base=gyro))
    left_radps = model.turns.gyro_bias_deviation
    expected = (left_radps * period_s) ** 2 + noise_rad2
    assert after.covariance[5, 5] == pytest.approx(expected)


def test_robot_that_is_carried_does_not_teach_the_gyro_a_bias():
    drive = Drive()
    for _ in range(100):
        drive.step(speed=0.0, rate=0.0, gyro=constant_rate(0.3), teaches=False)
    assert np.abs(drive.model.turns.gyro_bias).max() < 0.002


def test_without_wheels_the_velocity_goes_on_and_the_gyro_turns_it():
    model = MotionModel(FREE)
    for index in range(3):
        model.predict(Observation(stamp_ns=index * 100_000_000))
        model.learn(se3.from_xy_yaw(0.1, 0.0, 0.05), SCAN)
    motion = model.predict(Observation(stamp_ns=300_000_000))
    np.testing.assert_allclose(motion.T_prev_curr, se3.from_xy_yaw(0.1, 0.0, 0.05), atol=1e-4)
    assert not motion.is_measured
    (anywhere,) = motion.alternatives
    assert anywhere.is_unknown
    gyro = constant_rate(-0.5)
    motion = model.predict(Observation(stamp_ns=400_000_000, gyro_base=gyro))
    assert se3.yaw_rad(motion.T_prev_curr) == pytest.approx(-0.05)


@pytest.mark.parametrize(("swing_s", "share"), [(np.inf, [0.85, 0.95]), (1.0, [0.0, 0.1])])
def test_velocity_that_nothing_measures_lasts_as_long_as_velocities_did_before(swing_s, share):
    """Driven for 20 s at a steady speed, or to and fro; then nothing is measured for 2 s."""
    model, blind = MotionModel(FREE), np.diag([1e6, 0.004, 1e-4, 1e-4, 1e-4, 0.002]) ** 2
    velocities = []
    for step in range(221):
        model.predict(Observation(stamp_ns=round(step * PERIOD_S * 1e9)))
        speed = 0.5 * np.cos(2.0 * np.pi * step * PERIOD_S / swing_s)
        if 0 < step <= 200:
            model.learn(se3.from_xy_yaw(speed * PERIOD_S, 0.0, 0.0), SCAN)
        elif step > 200:
            model.learn(se3.identity(), blind)
        velocities.append(model.inertia.velocity[0])
    assert velocities[200] == pytest.approx(0.5, rel=0.02)
    assert share[0] < velocities[-1] / 0.5 < share[1]


def test_velocity_without_wheels_is_that_of_several_measurements_where_one_is_uncertain():
    """A scan that is off by 1 cm would alone tell a velocity that is off by 0.3 m/s."""
    model, rng, off = MotionModel(FREE), np.random.default_rng(1), []
    noisy = np.diag([0.01, 0.01, 1e-4, 1e-4, 1e-4, 0.002]) ** 2
    for step in range(150):
        model.predict(Observation(stamp_ns=round(step * 1e9 / 30)))
        if step:
            seen = np.sqrt(np.diag(noisy)) * rng.standard_normal(6)
            model.learn(se3.from_xy_yaw(0.5 / 30, 0.0, 0.0) @ se3.exp(seen), noisy)
            off.append(model.inertia.velocity[:2] - [0.5, 0.0])
    assert np.sqrt(np.mean(np.square(off[30:]))) < 0.1


def test_first_motion_after_a_stop_is_no_velocity():
    model = MotionModel(FREE)
    model.predict(Observation(stamp_ns=0))
    model.stop()
    model.predict(Observation(stamp_ns=100_000_000))
    model.learn(se3.from_xy_yaw(2.0, 0.0, 0.0), SCAN)  # of longer than the one step
    assert not model.inertia.velocity.any()
    model.predict(Observation(stamp_ns=200_000_000))
    model.learn(se3.from_xy_yaw(0.1, 0.0, 0.0), SCAN)
    assert model.inertia.velocity[0] == pytest.approx(1.0, rel=0.01)
