"""Dirt on the lens: what stays in the image while a rotation of the robot moves the view."""

import numpy as np
import pytest

from sceneslam.modules.detectors.lens import Dirt
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor

S = 10**9
H, W = 40, 96  # of the downscaled image [px]
TURN_RAD = 0.3
REACH = 4  # [px] to either side: tolerance of the comparison
VIEW, SPOT = 100, 200  # grey values


def picture(columns, rows=slice(10, 16), *, view=VIEW, spot=SPOT):
    """Return a view (H, W) of one grey value with a spot of another."""
    image = np.full((H, W), view, np.uint8)
    image[rows, columns] = spot
    return image


class Drive:
    """A robot with a camera and wheels that turns on the spot."""

    def __init__(self, shift_px=20, image_width_px=W):
        fx = shift_px / np.tan(TURN_RAD) * image_width_px / W
        sensors = frozenset({Sensor.IMAGE, Sensor.ODOMETRY})
        camera = Camera(size_wh=(image_width_px, 1), fx=fx, fy=fx, cx=0.0, cy=0.0)
        self.dirt = Dirt(Rig(sensors=sensors, camera=camera))
        self._scale = image_width_px // W
        self._stamp_ns, self._yaw_rad = 5 * S, 1.0
        self.see(None)

    def see(self, image, turn_rad=0.0, after_ns=S // 10, **other):
        """Return the dirty ratio after a turn to the left and an image (H, W)."""
        self._stamp_ns += after_ns
        self._yaw_rad += turn_rad
        T_odom_base = se3.from_xy_yaw(2.0, 3.0, self._yaw_rad)
        if image is not None:
            image = np.repeat(
                np.kron(image, np.ones((self._scale,) * 2, np.uint8))[..., None], 3, 2
            )
        other = {"T_odom_base": T_odom_base, **other}
        return self.dirt(Observation(stamp_ns=self._stamp_ns, image_bgr=image, **other))

    def turn(self, before, now, turn_rad=TURN_RAD, **other):
        """Return the dirty ratio after two images with a turn to the left between them."""
        self.see(before)
        return self.see(now, turn_rad, **other)


def share(pixels, shift_px=20):
    """Return the share of pixels in the part of the view that is in both images."""
    return pytest.approx(pixels / (H * (W - shift_px)))


def slightly_brighter(image):
    """Return the same view as another image: an equal one is a frozen camera's."""
    return image + np.uint8(1)


@pytest.mark.parametrize("spot", [20, 200])
@pytest.mark.parametrize("turn_rad", [TURN_RAD, -TURN_RAD])
@pytest.mark.parametrize("image_width_px", [W, 2 * W])
def test_dirty_pixels_are_those_that_stay_during_a_rotation(spot, turn_rad, image_width_px):
    drive = Drive(image_width_px=image_width_px)
    drive.see(None, turn_rad)  # a yaw that no image was compared with
    image = picture(slice(40, 50), spot=spot)
    assert drive.turn(image, slightly_brighter(image), turn_rad) == share(6 * 10)


@pytest.mark.parametrize(
    ("columns", "turn_rad", "count"),
    [
        (slice(0, 10), TURN_RAD, 0),
        (slice(0, 10), -TURN_RAD, 10),
        (slice(15, 25), TURN_RAD, 5),
        (slice(86, 96), TURN_RAD, 10),
        (slice(86, 96), -TURN_RAD, 0),
        (slice(71, 81), -TURN_RAD, 5),
    ],
)
def test_pixels_that_a_rotation_moves_into_the_image_are_not_compared(columns, turn_rad, count):
    image = picture(columns)
    assert Drive().turn(image, slightly_brighter(image), turn_rad) == share(6 * count)


@pytest.mark.parametrize("turn_rad", [TURN_RAD, -TURN_RAD])
def test_a_moving_view_is_clean(turn_rad):
    shift_px = 20 if turn_rad > 0 else -20
    blocks = np.random.default_rng(0).integers(0, 256, (5, 17), dtype=np.uint8)
    panorama = np.kron(blocks, np.ones((8, 8), np.uint8))  # (40, 136)
    before, now = panorama[:, 20:116], panorama[:, 20 - shift_px : 116 - shift_px]
    assert Drive().turn(before, now, turn_rad) == 0.0


@pytest.mark.parametrize("turn_rad", [TURN_RAD, -TURN_RAD])
def test_a_spot_may_come_from_a_spot_within_four_pixels_of_the_expected_place(turn_rad):
    wide = picture(slice(30, 60))  # its last columns could be its first ones, moved
    assert Drive().turn(wide, slightly_brighter(wide), turn_rad) == share(6 * (20 - REACH))
    for rows, count in ((slice(16 + REACH, 26), 6), (slice(15 + REACH, 26), 5)):
        before = picture(slice(50, 60))
        before[rows, 50 - 20 : 60 - 20] = before[rows, 50 + 20 : 60 + 20] = SPOT
        assert Drive().turn(before, picture(slice(50, 60), view=101), turn_rad) == share(count * 10)


@pytest.mark.parametrize(
    ("before", "now", "count"),
    [
        (200, 207, 60),
        (200, 208, 0),
        (200, 193, 60),
        (200, 192, 0),
        (117, 117, 60),
        (116, 116, 0),
        (83, 83, 60),
        (84, 84, 0),
    ],
)
def test_a_spot_keeps_its_grey_value_within_8_and_differs_from_the_view_by_more_than_16(
    before, now, count
):
    images = [picture(slice(40, 50), spot=spot) for spot in (before, now)]
    images[0][0, 0] = 101  # not frozen
    assert Drive().turn(*images) == share(count)


def test_the_rotation_is_at_least_0_15_rad_and_at_most_half_an_image():
    image = picture(slice(60, 66))
    for turn_rad in (0.14, -0.14):
        assert Drive(60).turn(image, slightly_brighter(image), turn_rad) == 0.0
    shift_px = round(60 * np.tan(0.16) / np.tan(TURN_RAD))
    assert Drive(60).turn(image, slightly_brighter(image), 0.16) == share(36, shift_px)
    assert Drive(48).turn(image, slightly_brighter(image)) == share(36, 48)
    assert Drive(49).turn(image, slightly_brighter(image)) == 0.0
    assert Drive(0.4).turn(image, slightly_brighter(image)) == 0.0  # less than a pixel


def test_an_image_is_compared_with_the_latest_one_before_the_rotation():
    drive, image = Drive(), picture(slice(40, 50))
    drive.see(picture(slice(0)))
    drive.see(image, 0.1)
    assert drive.see(slightly_brighter(image), TURN_RAD) == share(60)


def test_a_camera_that_repeats_its_image_is_frozen_and_not_dirty():
    image = picture(slice(40, 50))
    other = slightly_brighter(image)
    drive = Drive()
    assert [drive.see(image, TURN_RAD) for _ in range(4)] == [0.0] * 4
    assert drive.see(other, TURN_RAD) == share(60)  # the last image is a new start
    drive = Drive()
    drive.see(image)
    drive.see(image, 0.2)
    assert drive.see(other, 0.1) == 0.0  # the first image was not there before the rotation
    drive = Drive()
    drive.see(image)
    drive.see(other)
    assert drive.see(image, TURN_RAD) == share(60)  # it repeats the one before the last


def test_images_are_compared_over_two_seconds_and_a_result_is_valid_as_long():
    image = picture(slice(40, 50))
    for after_ns, ratio in ((2 * S, share(60)), (2 * S + 1, 0.0)):
        assert Drive().turn(image, slightly_brighter(image), after_ns=after_ns) == ratio
        drive = Drive()
        drive.turn(image, slightly_brighter(image))
        assert drive.see(None, after_ns=after_ns) == ratio
    drive = Drive()
    drive.see(image)
    drive.see(slightly_brighter(image), 0.1, after_ns=S)
    assert drive.see(image, 0.1, after_ns=S + 1) == 0.0  # only the first image is 0.15 rad away


def test_the_ratio_is_the_median_of_seven_comparisons():
    drive, ratios = Drive(), []
    for index, is_dirty in enumerate([0, 0, 1, 1, 1, 1, 1, 0, 0, 0, 0]):
        image = picture(slice(40, 50) if is_dirty else slice(0), view=VIEW + index % 2)
        ratios.append(drive.see(image, TURN_RAD))
    # Clean pairs: the first two, and the last four; dirty pairs: the four between.
    full = 60 / (H * (W - 20))
    medians = [0, 0, 0, 0, 0.5, 1, 1, 1, 1, 1, 0]
    assert ratios == pytest.approx([full * one for one in medians])


def test_the_rotation_is_the_gyros_around_the_vertical_axis_and_else_the_wheels():
    image = picture(slice(40, 50))
    rate_radps = [0.5, -2.0, TURN_RAD / 0.1]
    gyro_base = np.array([[time_s, *rate_radps] for time_s in (-0.08, -0.04, 0.0)])
    drive = Drive()
    drive.see(image)
    assert drive.see(slightly_brighter(image), gyro_base=gyro_base) == share(60)
    assert Drive().turn(image, slightly_brighter(image), T_odom_base=None) == 0.0
    no_number = np.full((4, 4), np.nan)
    drive = Drive()
    drive.see(image)
    assert drive.see(None, T_odom_base=no_number) == 0.0
    drive.see(None)
    assert drive.see(slightly_brighter(image), TURN_RAD) == share(60)


def test_without_a_camera_nothing_is_dirty():
    dirt = Dirt(Rig(sensors=frozenset({Sensor.IMAGE})))
    images = [np.full((8, 8, 3), grey, np.uint8) for grey in (10, 20)]
    assert [dirt(Observation(stamp_ns=k, image_bgr=one)) for k, one in enumerate(images)] == [0, 0]
