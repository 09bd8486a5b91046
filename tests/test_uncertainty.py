"""The trajectory's covariance: marginals through hand-overs and loops."""

from dataclasses import replace

import numpy as np
import pytest
from driving import drive, events
from fakes import ExactModule

from sceneslam.atlas.covariances import PosedPath, calibrated, covariances
from sceneslam.atlas.submaps.graph import LOADED
from sceneslam.atlas.submaps.submap import LENGTH_M
from sceneslam.atlas.uncertainty import (
    MAPPED,
    VELOCITY,
    of_wheels,
    read_covariances,
    write_covariances,
)
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.storage.events import log_uncertainty
from sceneslam.types import se3
from sceneslam.types.rig import Wheels
from sceneslam.types.trajectory import Trajectory

STEP_M = 0.1
T_STEP = se3.from_xy_yaw(STEP_M, 0.0, 0.05)
SUBMAP = round(LENGTH_M / STEP_M)  # poses
WHEELS = of_wheels(Wheels())
CLAIM = np.diag([4.0, 4.0, 4.0, 1.0, 1.0, 1.0]) * 1e-6  # 2 mm, 1 mrad


def path_of(kinds, claim=None, T_step=T_STEP):
    """One pose per kind: a session's number, or "-" where it is bridged."""
    sessions = [0]
    for kind in kinds:
        sessions.append(sessions[-1] if kind == "-" else int(kind))
    return PosedPath(
        T_map_base=np.array([np.linalg.matrix_power(T_step, index) for index in range(len(kinds))]),
        sessions=np.array(sessions[1:]),
        is_bridged=np.array([kind == "-" for kind in kinds]),
        reported=np.array([np.full((6, 6), np.nan) if claim is None else claim] * len(kinds)),
        of_maps=np.full((len(kinds), 6, 6), np.nan),
    )


def solved(path, bridge=WHEELS, loops=()):
    return covariances(path, loops=loops, bridge=bridge)


def loop(first, second, sigma):
    return Edge(
        first=first,
        second=second,
        T_first_second=np.eye(4),
        covariance=sigma**2 * np.eye(6),
        kind=EdgeKind.LOOP,
    )


def position_m(covariance):
    return np.sqrt(np.trace(covariance[:3, :3]))


def test_the_map_begins_where_the_first_pose_is():
    np.testing.assert_allclose(solved(path_of("0"))[0], np.zeros((6, 6)), atol=1e-9)
    assert solved(path_of("")).shape == (0, 6, 6)


def wrong_path(rng, kinds, claim):
    """A path whose errors are as claimed: of each pose beside its map, and of each new submap."""
    path = path_of(kinds, claim, T_step=se3.from_xy_yaw(STEP_M, 0.0, 0.0))
    root, estimated, T_wrong = np.linalg.cholesky(claim), [], np.eye(4)
    for row in range(len(kinds)):
        if row and path.sessions[row] != path.sessions[row - 1]:
            T_wrong = estimated[-1] @ se3.inverse(path.T_map_base[row - 1])
        elif row:
            drift = se3.exp(root @ rng.normal(size=6) / np.sqrt(SUBMAP))
            T_true = path.T_map_base[row]
            T_wrong = T_wrong @ T_true @ drift @ se3.inverse(T_true)
        beside = se3.exp(root @ rng.normal(size=6)) if row else np.eye(4)
        estimated.append(T_wrong @ path.T_map_base[row] @ beside)
    return path, np.array(estimated)


def test_errors_are_as_large_as_the_covariance_before_and_after_a_seam():
    rng, kinds = np.random.default_rng(0), "0" * (2 * SUBMAP) + "1" * (2 * SUBMAP)
    nees = []
    for _ in range(30):
        path, estimated = wrong_path(rng, kinds, CLAIM)
        errors = se3.log(se3.inverse(estimated) @ path.T_map_base)
        found = solved(path)
        level = [0, 1, 5]  # the true path is level, which bounds the other axes
        found, errors = found[:, level][:, :, level], errors[:, level]
        nees.append(np.einsum("ni,nij,nj->n", errors[1:], np.linalg.inv(found[1:]), errors[1:]) / 3)
    before, after = np.mean(nees, axis=0)[: 2 * SUBMAP - 1], np.mean(nees, axis=0)[2 * SUBMAP :]
    assert 0.7 < before.mean() < 1.4 and 0.7 < after.mean() < 1.4


def test_poses_of_one_submap_share_its_error():
    found = solved(path_of("0" * (SUBMAP + 1), CLAIM, T_step=se3.from_xy_yaw(STEP_M, 0.0, 0.0)))
    assert found[0, 0, 0] == pytest.approx(CLAIM[0, 0], rel=1e-3)  # the pose's own
    assert found[-1, 0, 0] == pytest.approx(2.0 * CLAIM[0, 0], rel=1e-3)  # and the submap's


def test_a_loop_makes_the_path_as_certain_as_it_is_measured():
    path = path_of("0" * (4 * SUBMAP))
    found, closed = solved(path), solved(path, loops=[loop(0, 75, 1e-3)])
    assert position_m(closed[75]) == pytest.approx(np.sqrt(3) * 1e-3, rel=0.1)
    assert (np.linalg.eigvalsh(found - closed) > -1e-12).all()


def test_a_path_is_as_certain_in_a_loaded_map_as_it_was_located():
    found = solved(path_of("0" * SUBMAP), loops=[loop(LOADED, 0, 0.02)])
    assert position_m(found[0]) == pytest.approx(np.sqrt(3) * 0.02)


def test_a_bridge_costs_more_certainty_than_a_module_and_a_guess_more_than_wheels():
    held, driven = solved(path_of("000000")), solved(path_of("0-----"))
    guessed = solved(path_of("0-----"), VELOCITY)
    deviations = [position_m(found[-1]) for found in (held, driven, guessed)]
    assert deviations[0] < 0.5 * deviations[1] < 0.25 * deviations[2]
    assert deviations[1] == pytest.approx(np.sqrt(3) * WHEELS.per_m * 0.5, rel=0.2)
    assert MAPPED.per_m < WHEELS.per_m


def test_a_module_that_comes_back_where_it_was_placed_is_as_certain_as_if_it_had_not_been_away():
    away, held = solved(path_of("000---000")), solved(path_of("000000000"))
    assert position_m(away[5]) > position_m(held[5])
    assert position_m(away[-1]) == pytest.approx(position_m(held[-1]), rel=0.02)


def test_a_bridge_before_a_handover_is_not_regained():
    found = solved(path_of("000---111111"))
    assert (np.diff([position_m(one) for one in found]) >= -1e-6).all()


def test_an_uncertain_heading_becomes_an_uncertain_position_along_the_way():
    path = path_of("0" * 101, np.diag([0, 0, 0, 0, 0, 1e-4]), se3.from_xy_yaw(0.1, 0.0, 0.0))
    found = solved(path)[-1]
    assert np.sqrt(found[1, 1]) == pytest.approx(0.01 * np.hypot(np.hypot(7.5, 5.0), 2.5), rel=0.05)
    assert found[0, 0] == pytest.approx(0.0, abs=1e-8)


def test_height_and_tilt_are_as_certain_as_the_floor_is_level():
    unsure = 0.1**2 * np.eye(6)
    flat = path_of("00001111", CLAIM)
    flat.reported[4:] = unsure
    assert (np.diag(solved(flat)[-1])[2:5] < [9e-6, 3e-6, 3e-6]).all()
    climbing = path_of("00001111", CLAIM, se3.exp(np.array([0.1, 0.0, 0.1, 0.0, 0.1, 0.0])))
    climbing.reported[4:] = unsure
    assert (np.diag(solved(climbing)[-1])[[2, 4]] > 100 * CLAIM[[2, 4], [2, 4]]).all()


def differing(T_off_m, T_step=T_STEP, *, poses=20):
    """Two sessions of one path over the same observations, apart by more and more."""
    T = path_of("0" * poses, T_step=T_step).T_map_base
    off = np.array([se3.from_xy_yaw(T_off_m * row / 20, 0.0, 0.0) for row in range(poses)])
    return [Trajectory(stamps_ns=np.arange(poses), T_world_base=one) for one in (T, T @ off)]


def test_a_claim_is_held_against_the_difference_at_the_handover():
    path = path_of("0" * 20 + "1" * 20, CLAIM)
    path.reported[20:] *= 1e4
    good, bad = (
        calibrated(path, "ab", differing(off_m, poses=101)).reported for off_m in (0.002, 0.5)
    )
    assert good[0, 0, 0] == pytest.approx(CLAIM[0, 0], rel=0.1)
    assert good[-1, 0, 0] < 1e-2 * path.reported[-1, 0, 0]  # 20 cm were claimed, 2 mm seen
    assert bad[-1, 0, 0] > 3.0 * good[-1, 0, 0]
    resting = calibrated(path, "ab", differing(0.002, np.eye(4)))
    np.testing.assert_array_equal(resting.reported, path.reported)


def test_a_drift_that_a_module_knows_of_is_no_error_of_the_other():
    path = path_of("0" * 20 + "1" * 20, CLAIM)
    path.of_maps[20:] = np.linspace(0.0, 0.05, 20)[:, None, None] ** 2 * np.eye(6)
    drifting = differing(0.02, poses=101)
    found, blamed = (
        calibrated(each, "ab", drifting).reported[0, 0, 0]
        for each in (path, replace(path, of_maps=np.full((40, 6, 6), np.nan)))
    )
    assert found < 2.0 * CLAIM[0, 0] < 0.5 * blamed


@pytest.mark.parametrize(("poses", "ratio"), [(5, 0.227), (20, 0.0127), (101, 7.9e-4)])
def test_a_comparison_says_the_more_of_a_claim_the_longer_it_is(poses, ratio):
    path = path_of("0" * 20 + "1" * 20, CLAIM)
    path.reported[20:] *= 1e4  # of which 1e-4 is seen, over n submaps: 1e-4 ** (n / (1 + n))
    found = calibrated(path, "ab", differing(0.002, poses=poses)).reported[-1, 0, 0]
    assert found / path.reported[-1, 0, 0] == pytest.approx(ratio, rel=0.1)


def test_a_module_that_rests_is_compared_with_none():
    path = path_of("0" * 20 + "1" * 20, CLAIM)
    moving, resting = differing(0.002)[0], differing(0.002, np.eye(4))[0]
    for pair in ([moving, resting], [resting, moving]):
        np.testing.assert_array_equal(calibrated(path, "ab", pair).reported, path.reported)


@pytest.mark.parametrize("certain", [0.0, 1e-9, 1e-4])
def test_claims_of_any_size_are_compared(certain):
    path = path_of("0" * 20 + "1" * 20, certain * np.eye(6))
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 6)))[0]
    path.reported[20:] = turn @ np.diag(np.logspace(2, 10, 6)) @ turn.T
    found = calibrated(path, "ab", differing(0.0)).reported
    assert np.isfinite(found).all()
    assert found[-1, 0, 0] > 0.0


def test_a_bridge_is_as_certain_as_the_wheels_of_the_rig():
    lost = {"bright": ExactModule(lost=range(20, 100)), "dark": ExactModule(lost=range(100))}
    _, atlas, _, _ = drive(lost)
    usual, poor = (
        np.sqrt(atlas.covariances(Wheels(drift_ratio=ratio))[-1, 0, 0]) for ratio in (0.02, 0.2)
    )
    assert poor > 5.0 * usual


def test_a_run_logs_how_certain_every_session_was_where_it_began():
    modules = {"bright": ExactModule(), "dark": ExactModule()}
    _, atlas, log, _ = drive(modules, scene_at=lambda i: "Dark" if i >= 40 else "Bright")
    covariances = atlas.covariances(Wheels())
    log_uncertainty(log, atlas.session_starts(), covariances)
    told = events(log, "uncertainty")
    assert [event["module"] for event in told] == ["bright", "dark"]
    assert told[0]["deviation_m"] < 1e-4 < told[1]["deviation_m"] < 0.2
    assert covariances.shape == (len(atlas.trajectory), 6, 6)
    assert (np.linalg.eigvalsh(covariances) >= -1e-12).all()


def test_covariances_are_read_as_they_were_written(tmp_path):
    found = solved(path_of("000--111", 1e-4 * np.eye(6)))
    stamps_ns = np.append([-500_000_000], 10**18 + np.arange(7) * 33_333_333)
    write_covariances(tmp_path / "covariance.txt", stamps_ns, found)
    stamps_read_ns, read = read_covariances(tmp_path / "covariance.txt")
    np.testing.assert_array_equal(stamps_read_ns, stamps_ns)
    np.testing.assert_allclose(read, found, rtol=1e-5, atol=1e-15)
