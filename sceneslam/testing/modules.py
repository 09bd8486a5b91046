"""Contract checks of SLAM modules; each takes a function that makes a new module."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from sceneslam.answers import checked_layers, checked_tracking, checked_trajectory
from sceneslam.interfaces import SlamModule
from sceneslam.testing.promise import accepted, expect
from sceneslam.testing.room import RIG, room_observation
from sceneslam.types import se3
from sceneslam.types.observation import Observation, Tracking, TrackingStatus

Make = Callable[[], SlamModule]
STEPS = 20  # of a robot that drives an arc at 0.3 m/s through a textured room, at 30 Hz
_NEAR_M, _NEAR_RAD = 0.05, 0.05
_FIELDS = ("image_bgr", "depth_m", "scan", "points_lidar", "T_odom_base")
_FAR_M = 20.0  # no map of the room reaches farther


def check_module(make: Make, *, is_reproducible: bool = True) -> None:
    """Raise ContractError if a module violates the contract of `SlamModule`.

    The robot drives through a small room with all sensors; `make` returns a new module each time. A
    module whose threads race is not reproducible.
    """
    for check in MODULE_CHECKS:
        if is_reproducible or check is not repeats_itself:
            check(make)


def fulfils_the_protocol(make: Make) -> None:
    """Check that the module has all members, and names its required sets of sensors."""
    with _active(make) as module:
        expect(isinstance(module, SlamModule), "all members of SlamModule")
        is_sets = module.requires and all(isinstance(one, frozenset) for one in module.requires)
        expect(is_sets, "requires: a tuple of frozensets of Sensor", module.requires)


def begins_at_the_identity(make: Make) -> None:
    """Check that `local` is `base` at the first observation."""
    with _active(make) as module:
        tracking = module.track(room_observation(0))
        _expect_pose(tracking, "at the first observation")
        at_start = np.allclose(tracking.T_local_base, np.eye(4), atol=1e-9)
        expect(at_start, "T_local_base at the first observation: the identity", tracking)


def follows_a_known_motion(make: Make) -> None:
    """Check that the error is at most 5 cm and 0.05 rad over 0.2 m."""
    T_first = room_observation(0).T_odom_base
    assert T_first is not None
    with _active(make) as module:
        for index, tracking in enumerate(_drive(module)):
            _expect_pose(tracking, f"at observation {index}")
            T_room_base = room_observation(index).T_odom_base
            assert T_room_base is not None
            T_true_base = se3.inverse(se3.inverse(T_first) @ T_room_base) @ tracking.T_local_base
            off_m = float(np.linalg.norm(T_true_base[:3, 3]))
            off_rad = float(se3.rotation_angle_rad(T_true_base))
            is_near = off_m < _NEAR_M and off_rad < _NEAR_RAD
            promise = f"at observation {index} within {_NEAR_M} m, {_NEAR_RAD} rad of the truth"
            expect(is_near, promise, f"{off_m:.3f} m, {off_rad:.3f} rad")


def answers_with_rigid_poses_at_the_stamp(make: Make) -> None:
    """Check that poses are float64 and rigid, and covariances not negative."""
    with _active(make) as module:
        for index, tracking in enumerate(_drive(module)):
            accepted(checked_tracking, tracking, room_observation(index).stamp_ns)
            T, stamp_ns = tracking.T_local_base, room_observation(index).stamp_ns
            expect(tracking.stamp_ns == stamp_ns, f"stamp_ns {stamp_ns}", tracking.stamp_ns)
            expect(T.dtype == np.float64 and T.shape == (4, 4), "T_local_base: (4, 4) float64", T)
            rotation = T[:3, :3]
            is_rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
            expect(is_rigid and np.linalg.det(rotation) > 0, "T_local_base: a rotation", rotation)
            if tracking.covariance is not None:
                least = np.linalg.eigvalsh(tracking.covariance).min()
                is_square = tracking.covariance.shape == (6, 6)
                expect(is_square and least >= -1e-12, "covariance: (6, 6), none below 0", least)


def repeats_itself(make: Make) -> None:
    """Check that two runs are bitwise equal, also after a second activation."""
    with _active(make) as one, _active(make) as two:
        runs = [_drive(one), _drive(two)]
        one.shutdown()
        one.activate(RIG)
        one.set_scene("Bright")
        for again in (runs[1], _drive(one)):
            for first, second in zip(runs[0], again, strict=True):
                is_same = np.array_equal(first.T_local_base, second.T_local_base)
                expect(is_same and first.status is second.status, f"{first} again", second)


def starts_anew_when_activated_again(make: Make) -> None:
    """Check that `local` of a second session is `base` at its first observation."""
    with _active(make) as module:
        _drive(module)
        module.shutdown()
        module.activate(RIG)
        tracking = module.track(room_observation(STEPS))
        _expect_pose(tracking, "at the first observation of a second session")
        at_start = np.allclose(tracking.T_local_base, np.eye(4), atol=1e-9)
        expect(at_start, "the identity at the first observation after activate", tracking)


def survives_blind_sensors(make: Make) -> None:
    """Check that black images, no depth and no returns give LOST or a pose, never NaN."""
    for begin in (0, 5):
        with _active(make) as module:
            _drive(module, begin)
            for index in range(begin, begin + 7):
                _expect_finite(module.track(without_measurements(room_observation(index))), "blind")
            module.get_map()


def survives_silent_sensors(make: Make) -> None:
    """Check that each sensor may be None for a while."""
    for field in _FIELDS:
        with _active(make) as module:
            for index in range(6):
                silent = {field: None} if index in (2, 3) else {}
                observation = replace(room_observation(index), **silent)  # type: ignore[arg-type]
                _expect_finite(module.track(observation), f"without {field}")


def maps_in_local(make: Make) -> None:
    """Check that points and grid are finite float32 and within the room."""
    with _active(make) as module:
        _drive(module)
        accepted(checked_trajectory, module.get_trajectory())
        layers = module.get_map()
        accepted(checked_layers, layers)
        if layers.points is not None:
            points = layers.points.points
            is_cloud = points.dtype == np.float32 and points.shape[1:] == (3,)
            expect(is_cloud, "points: (N, 3) float32", f"{points.dtype} {points.shape}")
            is_near = np.isfinite(points).all() and np.abs(points).max(initial=0) < _FAR_M
            expect(is_near, f"points within {_FAR_M} m")
        if layers.grid is not None:
            cells = layers.grid.log_odds
            is_grid = cells.dtype == np.float32 and np.isfinite(cells).all()
            expect(is_grid, "grid.log_odds: finite float32", cells.dtype)


def keeps_its_map_after_shutdown(make: Make) -> None:
    """Check that shutdown may be called twice, and the map stays readable."""
    with _active(make) as module:
        _drive(module, 5)
        before = module.get_map()
        module.shutdown()
        module.shutdown()
        after = module.get_map()
        if before.points is not None:
            is_kept = after.points is not None and np.array_equal(
                before.points.points, after.points.points
            )
            expect(is_kept, "the same points after shutdown")


MODULE_CHECKS: Sequence[Callable[[Make], None]] = (
    fulfils_the_protocol,
    begins_at_the_identity,
    follows_a_known_motion,
    answers_with_rigid_poses_at_the_stamp,
    repeats_itself,
    starts_anew_when_activated_again,
    survives_blind_sensors,
    survives_silent_sensors,
    maps_in_local,
    keeps_its_map_after_shutdown,
)


def without_measurements(observation: Observation) -> Observation:
    """Return the observation with empty measurements: black image, no depth, no returns."""
    assert observation.image_bgr is not None and observation.depth_m is not None
    assert observation.scan is not None
    no_returns = np.full_like(observation.scan.ranges_m, np.nan)
    return replace(
        observation,
        image_bgr=np.zeros_like(observation.image_bgr),
        depth_m=np.zeros_like(observation.depth_m),
        scan=replace(observation.scan, ranges_m=no_returns),
        points_lidar=np.zeros((0, 3), np.float32),
    )


@contextmanager
def _active(make: Make) -> Iterator[SlamModule]:
    module = make()
    module.activate(RIG)
    try:
        module.set_scene("Bright")
        yield module
    finally:
        module.shutdown()


def _drive(module: SlamModule, steps: int = STEPS) -> list[Tracking]:
    return [module.track(room_observation(index)) for index in range(steps)]


def _expect_pose(tracking: Tracking, when: str) -> None:
    expect(tracking.status is not TrackingStatus.LOST, f"a pose {when}", tracking.status)


def _expect_finite(tracking: Tracking, when: str) -> None:
    is_finite = np.isfinite(tracking.T_local_base).all()
    expect(is_finite, f"a finite T_local_base while {when}", tracking.T_local_base)
