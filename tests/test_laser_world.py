"""A world of straight walls for the laser's tests: rays against line segments."""

import numpy as np

from sceneslam.types import se3
from sceneslam.types.observation import LaserScan, Observation


def box(x_min, y_min, x_max, y_max):
    """Return the four walls (4, 2, 2) of a rectangle."""
    corners = np.array([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max]], float)
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def room():
    """Return a room of 6 m x 4 m with furniture that makes every direction plain."""
    return np.concatenate(
        [box(-2, -2, 4, 2), box(2.5, 1.2, 3.2, 2), box(0.5, -2, 1.5, -1.5), box(-2, 0.8, -1.4, 1.4)]
    )


def corridor():
    """Return two parallel walls that end beyond what a laser sees."""
    return np.array([[[-200, -1], [200, -1]], [[-200, 1], [200, 1]]], float)


def cast(walls, T_world_laser, angles_rad):
    """Return the distance of the nearest wall per beam, inf where there is none."""
    origin = T_world_laser[:2, 3]
    heading = angles_rad + se3.yaw_rad(T_world_laser)
    ray = np.stack([np.cos(heading), np.sin(heading)], axis=1)[:, None]
    start, along = walls[None, :, 0] - origin, (walls[:, 1] - walls[:, 0])[None]
    cross = ray[..., 0] * along[..., 1] - ray[..., 1] * along[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (start[..., 0] * along[..., 1] - start[..., 1] * along[..., 0]) / cross
        share = (start[..., 0] * ray[..., 1] - start[..., 1] * ray[..., 0]) / cross
    hit = (distance > 0) & (share >= 0) & (share <= 1)
    return np.where(hit, distance, np.inf).min(axis=1)


def scan_at(
    walls, T_world_laser, *, stamp_ns, rng=None, beams=360, fov_rad=2 * np.pi, range_max_m=12.0
):
    """Return a scan with 1 cm of noise where there is a generator."""
    step = fov_rad / beams
    angles = -fov_rad / 2 + step * np.arange(beams)
    ranges = cast(walls, T_world_laser, angles)
    if rng is not None:
        ranges = ranges + rng.normal(0.0, 0.01, beams)
    ranges[ranges > range_max_m] = np.inf
    return LaserScan(
        stamp_ns=stamp_ns,
        ranges_m=ranges.astype(np.float32),
        angle_min_rad=-fov_rad / 2,
        angle_step_rad=step,
        range_min_m=0.05,
        range_max_m=range_max_m,
    )


def drive(walls, path, *, odometry=None, rng=None, period_ns=100_000_000, **scan):
    """Return the observations along a path of (x, y, yaw)."""
    return [
        Observation(
            stamp_ns=index * period_ns,
            scan=scan_at(
                walls, se3.from_xy_yaw(*pose), stamp_ns=index * period_ns, rng=rng, **scan
            ),
            T_odom_base=None if odometry is None else se3.from_xy_yaw(*odometry[index]),
        )
        for index, pose in enumerate(path)
    ]


def loop_path(count):
    """Return a smooth closed path (count, 3) through the room, looking where it goes and around."""
    t = np.linspace(0, 2 * np.pi, count)
    return np.column_stack([0.5 + np.cos(t), 0.6 * np.sin(t), 0.8 * np.sin(2 * t)])


def test_rays_meet_the_walls_of_a_box():
    ranges = cast(box(-1, -2, 3, 4), np.eye(4), np.array([0, np.pi / 2, np.pi, -np.pi / 2]))
    np.testing.assert_allclose(ranges, [3, 4, 1, 2])


def test_rays_along_a_corridor_meet_nothing():
    assert cast(corridor(), np.eye(4), np.array([0.0]))[0] == np.inf
