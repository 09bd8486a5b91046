"""Lines through the end points of beams, and the walls drawn from them."""

import numpy as np
import pytest

from sceneslam.atlas.places.floor_plan import draw
from sceneslam.scans.key_scan import KeyScan, line_normals


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
