"""Lines through the end points of beams, and the walls drawn from them."""

from dataclasses import replace

import numpy as np
import pytest

from sceneslam.atlas.places.floor_plan import draw
from sceneslam.scans.key_scan import KeyScan, KeyScanner, line_normals
from sceneslam.testing import room
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.trail import Trail


def test_a_late_scan_lies_where_it_was_taken() -> None:
    trail = Trail()
    for stamp_ns, x_m in ((0, 0.0), (100, 1.0), (200, 2.0)):
        trail.add(stamp_ns, se3.from_xy_yaw(x_m, 0.0, 0.0))
    late = replace(room.room_observation(0).scan, stamp_ns=50)
    made = [
        KeyScanner(room.RIG).make(Observation(stamp_ns=200, scan=scan), trail)
        for scan in (late, replace(late, stamp_ns=200))
    ]
    np.testing.assert_allclose(made[0].points, made[1].points - [1.5, 0.0], atol=1e-5)
    np.testing.assert_allclose(made[0].origin, made[1].origin - [1.5, 0.0], atol=1e-9)


def test_a_clouds_sweep_is_undone() -> None:
    """It turns at 1 rad/s in a room, and a sweep takes 0.1 s, from the stamp on."""
    trail = Trail()
    for index in (0, 1):
        trail.add(index * 10**8, se3.from_xy_yaw(0.0, 0.0, 0.1 * index))
    still = room.room_observation(0).points_lidar
    times_s = np.linspace(0.0, 0.1, len(still))
    turned = np.stack([se3.from_xy_yaw(0.0, 0.0, -time_s)[:3, :3] for time_s in times_s])
    swept = np.einsum("nij,nj->ni", turned, still).astype(np.float32)
    rig = replace(room.RIG, laser=None)
    made = [
        KeyScanner(rig).make(Observation(stamp_ns=10**8, **measured), trail)
        for measured in (
            {"points_lidar": still},
            {"points_lidar": swept, "point_times_s": times_s},
        )
    ]
    np.testing.assert_allclose(made[1].points, made[0].points, atol=1e-3)


def wall(beams_per_turn: int, away_m: float) -> KeyScan:
    """Return a scan of a wall to the left, which is seen within 45 degrees to either side."""
    angles = np.arange(np.pi / 4, 3 * np.pi / 4, 2 * np.pi / beams_per_turn)
    points = np.column_stack([away_m / np.tan(angles), np.full(len(angles), away_m)])
    return KeyScan(stamp_ns=0, points=points.astype(np.float32), origin=np.zeros(2))


@pytest.mark.parametrize("away_m", [1.0, 4.0, 6.0, 10.0])
@pytest.mark.parametrize("beams", [360, 720])
def test_a_wall_has_its_normal_near_and_far(beams: int, away_m: float) -> None:
    normals = line_normals(wall(beams, away_m))
    ahead = normals[len(normals) // 4 : -len(normals) // 4]
    np.testing.assert_allclose(ahead, np.tile([0.0, -1.0], (len(ahead), 1)), atol=1e-5)


def test_a_wall_ends_without_a_normal_by_two_beams() -> None:
    """Between beams 2 cm apart, noise alone would turn a line through three."""
    near, far = wall(360, 1.0), wall(360, 5.0)
    points = np.concatenate([near.points[:40], far.points[40:]])
    normals = line_normals(KeyScan(stamp_ns=0, points=points, origin=np.zeros(2)))
    assert not normals[37:40].any()
    assert normals[30:37].any(axis=1).all()


@pytest.mark.parametrize("beams", [360, 1440])
def test_what_one_of_many_scans_saw_is_no_wall(beams: int) -> None:
    """Where beams are dense, one scan has many end points per cell."""
    empty, person = wall(beams, 3.0), wall(beams, 1.0)
    plan = draw([(np.zeros(3), empty)] * 5 + [(np.zeros(3), person)])
    assert len(plan)
    assert plan.points[:, 1].min() > 2.9
