"""The trajectory's covariance: carried through hand-overs, growing on the way."""

import numpy as np
import pytest
from driving import drive, events
from fakes import ExactModule

from sceneslam.atlas.uncertainty import (
    MAPPED,
    VELOCITY,
    WHEELS,
    Drift,
    SessionPose,
    propagate,
    read_covariances,
    write_covariances,
)
from sceneslam.bus.handover_log import log_uncertainty
from sceneslam.types import se3

T_STEP = se3.from_xy_yaw(0.1, 0.0, 0.05)
NO_DRIFT = Drift(per_m=0.0, rad_per_m=0.0, rad_per_rad=0.0, rad_per_root=0.0)


def steps(kinds, covariance=None):
    """One pose per kind: a session's number, or "-" where it is bridged."""
    session, found = -1, []
    for index, kind in enumerate(kinds):
        session = session if kind == "-" else int(kind)
        T_map_base = np.linalg.matrix_power(T_STEP, index)
        found.append(
            SessionPose(
                T_map_base=T_map_base,
                session=session,
                is_bridged=kind == "-",
                covariance=None if kind == "-" else covariance,
            )
        )
    return found


def position_m(covariance):
    return np.sqrt(np.trace(covariance[:3, :3]))


def test_the_map_begins_where_the_first_pose_is():
    np.testing.assert_array_equal(propagate(steps("0"), WHEELS)[0], np.zeros((6, 6)))


def test_a_bridge_costs_more_certainty_than_a_module_and_a_guess_more_than_wheels():
    held, driven = propagate(steps("000000"), WHEELS), propagate(steps("0-----"), WHEELS)
    guessed = propagate(steps("0-----"), VELOCITY)
    deviations = [position_m(found[-1]) for found in (held, driven, guessed)]
    assert deviations[0] < 0.5 * deviations[1] < 0.25 * deviations[2]
    assert deviations[1] == pytest.approx(np.sqrt(3) * WHEELS.per_m * 0.5, rel=0.2)


def test_a_map_loses_the_rotation_by_the_root_of_the_way_and_wheels_by_the_way():
    kinds = {"held": "0" * 41, "driven": "0" + "-" * 40}
    for kind, ratio in (("held", 2.0), ("driven", 4.0)):
        found = propagate(steps(kinds[kind]), WHEELS)
        quarter, end = (np.sqrt(found[index, 5, 5]) for index in (10, 40))
        assert end / quarter == pytest.approx(ratio)


def test_what_was_lost_before_a_handover_is_never_regained():
    found = propagate(steps("000---111111"), WHEELS)
    assert (np.diff([position_m(one) for one in found]) >= 0).all()


def test_a_module_that_comes_back_where_it_was_placed_is_as_sure_as_if_it_had_not_been_away():
    away, held = propagate(steps("000---000"), WHEELS), propagate(steps("000000000"), WHEELS)
    assert position_m(away[5]) > position_m(held[5])
    assert position_m(away[-1]) == pytest.approx(position_m(held[-1]), rel=0.02)


def test_an_uncertain_heading_becomes_an_uncertain_position_along_the_way():
    start = np.diag([0, 0, 0, 0, 0, 0.1**2])
    turned = steps("0-", covariance=start)
    T_ahead = se3.from_xy_yaw(10.0, 0.0, 0.0)
    far = SessionPose(T_map_base=T_ahead, session=0, is_bridged=True, covariance=None)
    found = propagate([turned[0], far], NO_DRIFT)[-1]
    assert np.sqrt(found[1, 1]) == pytest.approx(10 * 0.1) and found[0, 0] == pytest.approx(0.0)


def test_the_share_of_the_old_module_goes_with_its_pose_into_the_next_session():
    unsure = 0.2**2 * np.eye(6)
    old, new = steps("00", covariance=unsure), steps("0011")[2:]
    found = propagate([*old, *new], WHEELS)
    assert position_m(found[-1]) >= np.sqrt(3) * 0.2
    assert MAPPED.per_m < WHEELS.per_m


def test_a_run_logs_how_sure_every_session_was_where_it_began():
    modules = {"bright": ExactModule(), "dark": ExactModule()}
    _, atlas, log, _ = drive(modules, scene_at=lambda i: "Dark" if i >= 40 else "Bright")
    covariances = atlas.covariances(True)
    log_uncertainty(log, atlas.session_starts(), covariances)
    told = events(log, "uncertainty")
    assert [event["module"] for event in told] == ["bright", "dark"]
    assert told[0]["deviation_m"] == 0.0 < told[1]["deviation_m"] < 0.2
    assert covariances.shape == (len(atlas.trajectory), 6, 6)
    assert (np.linalg.eigvalsh(covariances) >= -1e-12).all()


def test_covariances_are_read_as_they_were_written(tmp_path):
    covariances = propagate(steps("000--111", covariance=1e-4 * np.eye(6)), WHEELS)
    stamps_ns = 10**18 + np.arange(8) * 33_333_333
    write_covariances(tmp_path / "covariance.txt", stamps_ns, covariances)
    stamps_read_ns, read = read_covariances(tmp_path / "covariance.txt")
    np.testing.assert_array_equal(stamps_read_ns, stamps_ns)
    np.testing.assert_allclose(read, covariances, rtol=1e-5, atol=1e-15)
