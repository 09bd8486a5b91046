"""The do-no-harm gate: what wheels say of a module's motion."""

from __future__ import annotations

import numpy as np
import pytest
from driving import GATE
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneslam.bus.judging.gate import NOBODY, Gate, GateSettings, Witness
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.rig import Wheels

PERIOD_S = 0.1


def arc(step, *, speed_m_s=0.5, turn_rad_s=0.2):
    """The pose after so many steps along a circle."""
    T_step = se3.exp(np.array([speed_m_s * PERIOD_S, 0, 0, 0, 0, turn_rad_s * PERIOD_S]))
    return np.linalg.matrix_power(T_step, step)


def judged(module, *, odometry=arc, steps=100, revised_at=None):
    """Return the judgement at every step; `module` and `odometry` give a pose or None."""
    gate = Gate(GATE, Wheels())
    return [
        gate.update(
            round(step * PERIOD_S * 1e9),
            T_local_base=module(step),
            T_odom_base=odometry(step),
            is_revised=step == revised_at,
        )
        for step in range(steps)
    ]


def scaled(ratio):
    return lambda step: arc(step, speed_m_s=0.5 * ratio)


def jumping(at_step, x_m):
    def module(step):
        return se3.from_xy_yaw(x_m, 0.0, 0.0) @ arc(step) if step >= at_step else arc(step)

    return module


def trusted(judgements):
    return [judgement.is_trusted for judgement in judgements]


def test_a_module_that_moves_like_the_wheels_is_trusted_after_its_probation():
    judgements = judged(arc)
    assert trusted(judgements) == [False] * 10 + [True] * 90
    assert not judgements[5].is_wrong and judgements[5].turn_agrees


def test_a_scale_off_by_a_few_percent_is_what_wheels_have_themselves():
    assert judged(scaled(1.05))[-1].is_trusted


def test_a_scale_off_by_less_than_the_bounds_costs_the_distance_when_it_lasts():
    judgements = judged(scaled(1.1), steps=400)
    assert judgements[50].is_trusted
    assert judgements[-1].is_wrong and judgements[-1].turn_agrees


def test_a_jump_is_no_scale():
    assert judged(jumping(100, 1.0), steps=400)[-1].is_trusted


def test_a_wrong_scale_costs_the_trust_in_the_distance_but_not_in_the_turn():
    last = judged(scaled(0.75))[-1]
    assert last.is_wrong and last.turn_agrees and not last.is_trusted


def test_a_module_that_stands_still_while_the_robot_drives_is_not_even_believed_the_turn():
    last = judged(lambda step: np.eye(4), odometry=lambda step: arc(step, turn_rad_s=0.0))[-1]
    assert last.is_wrong and not last.turn_agrees


def test_a_jump_is_seen_at_once_and_forgiven_after_the_short_horizon_and_the_probation():
    judgements = judged(jumping(30, 1.0), steps=110)
    first = trusted(judgements).index(True, 30)
    assert not judgements[30].is_trusted and judgements[30].since_ns == 2_000_000_000
    assert first == 30 + 10 + 10 - 1
    assert all(trusted(judgements)[first:])


def test_a_jump_is_seen_in_the_first_second_too():
    judgements = judged(jumping(2, 0.5))
    assert not judgements[1].is_wrong and judgements[2].is_wrong
    assert judgements[2].since_ns == 0


def test_a_slow_drift_at_standstill_is_seen_over_the_long_horizon():
    drift = [
        judged(lambda step, v=v: se3.from_xy_yaw(v * PERIOD_S * step, 0, 0), odometry=lambda _: EYE)
        for v in (0.01, 0.05)
    ]
    assert drift[0][-1].is_trusted
    assert drift[1][15].is_trusted and drift[1][-1].is_wrong


EYE = np.eye(4)


def test_a_wrong_turn_costs_all_trust():
    last = judged(lambda step: arc(step, turn_rad_s=0.3))[-1]
    assert last.is_wrong and not last.turn_agrees and not last.is_trusted


def lost_between(module, first, last):
    return lambda step: None if first <= step < last else module(step)


def test_a_module_back_from_a_loss_where_the_wheels_are_is_trusted_at_once():
    judgements = judged(lost_between(arc, 40, 70))
    assert not judgements[50].is_trusted and judgements[70].is_trusted


def test_a_module_back_from_a_loss_elsewhere_is_not():
    judgements = judged(lost_between(jumping(70, 2.0), 40, 70), steps=140)
    assert not any(trusted(judgements)[40:89]) and all(trusted(judgements)[89:])


def test_without_odometry_nothing_is_held_against_a_module():
    judgement = judged(jumping(30, 1.0), odometry=lambda step: None)[31]
    assert judgement.is_trusted and not judgement.turn_agrees


def test_suspicion_lasts_between_two_measurements_of_odometry_but_not_without_any():
    def every_second_step_of_ten_seconds(step):
        return arc(step) if step % 2 == 0 and step < 100 else None

    judgements = judged(scaled(0.75), odometry=every_second_step_of_ten_seconds, steps=130)
    assert not any(trusted(judgements)[12:108]) and all(trusted(judgements)[109:])


def test_a_corrected_past_is_no_motion():
    assert not judged(jumping(30, 1.0))[30].is_trusted
    assert all(trusted(judged(jumping(30, 1.0), revised_at=30))[10:])


def test_a_past_corrected_while_odometry_is_missing_is_no_motion():
    def with_a_gap(step):
        return None if step in (30, 31) else arc(step)

    judgements = judged(jumping(30, 1.0), odometry=with_a_gap, revised_at=30)
    assert all(trusted(judgements)[10:])
    assert not judged(jumping(30, 1.0), odometry=with_a_gap)[32].is_trusted


@settings(deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=12, max_size=12))
def test_judgement_does_not_depend_on_where_the_frames_are(values):
    T_a, T_b = se3.exp(np.array(values[:6])), se3.exp(np.array(values[6:]))
    moved = judged(
        lambda step: T_a @ scaled(0.9)(step), odometry=lambda step: T_b @ arc(step), steps=20
    )
    for one, other in zip(judged(scaled(0.9), steps=20), moved, strict=True):
        assert one == other


def test_bridging_takes_the_way_and_the_tilt_from_the_wheels_and_the_heading_from_the_module():
    T_odom = se3.from_xy_yaw(0.1, 0.0, 0.3)
    rotation = se3.from_xy_yaw(0.2, 0.0, 0.1)[:3, :3] @ se3.so3_exp(np.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(
        se3.with_yaw(T_odom, se3.yaw_rad(rotation)), se3.from_xy_yaw(0.1, 0.0, 0.1), atol=1e-12
    )


def test_impossible_setting_is_named():
    with pytest.raises(ConfigError, match="sigmas"):
        GateSettings(sigmas=0.0)


def test_a_past_corrected_at_the_end_of_a_loss_is_no_motion():
    module = lost_between(jumping(70, 2.0), 40, 70)
    assert all(trusted(judged(module, revised_at=70))[70:])


def witnessed(
    module,
    *,
    odometry=arc,
    steps=100,
    deviation_m=0.005,
    witness=lambda step: NOBODY,
    period_s=PERIOD_S,
):
    """Return the judgements of a module that states how certain it is."""
    gate = Gate(GATE, Wheels())
    return [
        gate.update(
            round(step * period_s * 1e9),
            T_local_base=module(step),
            T_odom_base=odometry(step),
            deviation_m=deviation_m,
            witness=witness(step),
        )
        for step in range(steps)
    ]


def frozen(first, last, along=arc):
    """Stand still between two steps of a path, and go on from there."""

    def pose(step):
        return along(min(step, first) + max(step - last, 0))

    return pose


def reversing(first, last):
    """Drive backwards instead of forwards between two steps."""
    T_back = se3.exp(np.array([-0.05, 0, 0, 0, 0, 0.02]))
    poses = [np.eye(4)]
    for step in range(300):
        poses.append(poses[-1] @ (T_back if first <= step < last else arc(1)))
    return lambda step: poses[step]


@pytest.mark.parametrize("lie", [frozen(40, 90), reversing(40, 80)])
def test_wheels_that_begin_to_lie_do_not_cost_a_certain_module_its_trust(lie):
    judgements = witnessed(arc, odometry=lie, steps=200)
    assert not any(judgement.is_wrong for judgement in judgements)
    assert any(judgement.wheels_lie for judgement in judgements)
    assert not judgements[-1].wheels_lie


@pytest.mark.parametrize("lie", [frozen(40, 90), reversing(40, 80)])
def test_a_module_that_begins_to_lie_is_found_however_certain_it_is(lie):
    judgements = witnessed(lie, steps=200)
    assert not any(trusted(judgements)[55:80])
    assert not any(judgement.wheels_lie for judgement in judgements)


def test_a_small_jump_is_not_held_against_a_module_while_the_wheels_reverse():
    judgements = witnessed(jumping(70, 0.1), odometry=reversing(40, 90), steps=85)
    assert all(trusted(judgements)[10:]) and judgements[-1].wheels_lie


def test_what_was_found_of_the_wheels_stands_for_a_horizon_after_the_module_was_lost():
    module = lost_between(arc, 55, 200)
    lies = [one.wheels_lie for one in witnessed(module, odometry=frozen(40, 60), steps=200)]
    assert all(lies[54 : 54 + 51]) and not any(lies[54 + 51 :])


def test_a_long_slip_of_the_wheels_is_not_held_against_a_module_that_jumps_later():
    judgements = witnessed(jumping(280, 0.3), odometry=frozen(40, 250), steps=320)
    assert judgements[249].wheels_lie and not judgements[270].wheels_lie
    assert trusted(judgements)[279] and not trusted(judgements)[281]
    assert all(trusted(judgements)[302:])


@pytest.mark.parametrize("ratio", [0.7, 1.3])
def test_wheels_of_another_size_are_less_certain_than_a_module(ratio):
    judgements = witnessed(arc, odometry=scaled(ratio))
    assert all(trusted(judgements)[10:]) and judgements[-1].wheels_lie


def test_a_module_that_is_less_certain_than_wheels_are_is_not_believed_against_them():
    assert not witnessed(scaled(0.75), deviation_m=0.5)[-1].is_trusted


def test_a_module_that_jumps_is_found_though_the_wheels_have_another_size():
    judgements = witnessed(jumping(60, 1.0), odometry=scaled(0.7))
    assert trusted(judgements)[59] and not any(trusted(judgements)[61:])


@pytest.mark.parametrize("step", [2, 3, 4, 6])
def test_a_module_that_jumps_at_once_after_it_began_is_found_however_certain_it_is(step):
    judgements = witnessed(jumping(step, 0.4), steps=20)
    assert judgements[step].is_wrong
    assert not any(judgement.wheels_lie for judgement in judgements)


def spinning(step):
    """Turn twice as far as the robot does."""
    return arc(step, turn_rad_s=0.4)


@pytest.mark.parametrize(("missed_rad_s", "is_lie"), [(0.0, False), (0.03, False), (0.2, True)])
def test_a_turn_that_wheels_and_gyro_agree_on_refutes_a_certain_module(missed_rad_s, is_lie):
    def gyro(step):
        return Witness(missed_rad=missed_rad_s * PERIOD_S * step)

    last = witnessed(spinning, witness=gyro)[-1]
    assert last.wheels_lie is is_lie and last.is_wrong is not is_lie
    assert witnessed(spinning)[-1].wheels_lie  # without a gyro


def test_what_a_gyro_says_of_the_wheels_turn_is_not_said_of_their_distance():
    def straight(step):
        return arc(step, turn_rad_s=0.0)

    agreeing, lie = Witness(missed_rad=0.0), frozen(40, 90, along=straight)
    judgements = witnessed(straight, odometry=lie, steps=80, witness=lambda step: agreeing)
    assert not any(judgement.is_wrong for judgement in judgements) and judgements[-1].wheels_lie


def test_wheels_that_another_module_moves_with_refute_a_certain_module():
    vouched = witnessed(scaled(0.75), witness=lambda step: Witness(is_vouched=True))
    assert vouched[-1].is_wrong and not any(judgement.wheels_lie for judgement in vouched)
    assert witnessed(scaled(0.75))[-1].wheels_lie


def test_a_first_answer_that_is_a_little_off_is_no_jump():
    """Its map holds one scan then; the wheels have begun to tell the wrong sign before."""

    def module(step):
        return se3.from_xy_yaw(-0.06, 0.0, 0.0) @ arc(step) if step == 1 else arc(step)

    judgements = witnessed(module, odometry=reversing(0, 60), steps=20, deviation_m=0.02)
    assert not any(judgement.is_wrong for judgement in judgements)
    assert judgements[-1].wheels_lie


def test_a_ramp_refutes_no_module():
    """Wheels and gyro agree on the yaw; only the module sees that it climbs."""

    def climbing(step):
        pitched = -np.deg2rad(15.0) * min(max(step - 30, 0), 20) / 20
        T = np.eye(4)
        T[:3, :3] = se3.so3_exp(np.array([0.0, pitched, 0.0]))
        T[:3, 3] = [0.05 * step * np.cos(pitched), 0.0, -0.05 * step * np.sin(pitched)]
        return T

    judgements = witnessed(
        climbing,
        odometry=lambda step: arc(step, turn_rad_s=0.0),
        witness=lambda step: Witness(missed_rad=0.0),
    )
    assert not any(judgement.is_wrong for judgement in judgements)


@pytest.mark.parametrize("steps", [4, 7, 11, 25])
def test_who_stood_still_over_a_loss_is_wrong(steps):
    """A module that goes on from its last pose before the loss, or wheels that stuck in it."""
    stuck = frozen(100, 100 + steps)
    after = slice(100 + steps, 110 + steps)
    module = witnessed(lost_between(stuck, 101, 100 + steps), steps=130)[after]
    assert all(one.is_wrong and not one.wheels_lie for one in module)
    wheels = witnessed(lost_between(arc, 101, 100 + steps), odometry=stuck, steps=130)[after]
    assert all(one.wheels_lie and not one.is_wrong for one in wheels)


@pytest.mark.parametrize("rate_hz", [10, 30])
@pytest.mark.parametrize("gap_s", [0.5, 0.8, 1.0, 1.5, 3.0])
def test_a_gentle_start_during_a_loss_is_no_jump(gap_s, rate_hz):
    """The wheels are stuck; within the time of two velocities it shows that they are wrong."""

    def starting(step):
        driven_s = max(step / rate_hz - 5.0, 0.0)
        return se3.from_xy_yaw(
            0.15 * min(driven_s, 1.0) ** 2 + 0.3 * max(driven_s - 1.0, 0.0), 0, 0
        )

    end = round((5.0 + gap_s) * rate_hz)
    judgements = witnessed(
        lost_between(starting, 5 * rate_hz, end),
        odometry=lambda _: EYE,
        steps=end + 3 * rate_hz,
        period_s=1.0 / rate_hz,
    )
    assert all(one.wheels_lie for one in judgements[end + round(0.6 * rate_hz) :])
