"""Features of images, depth, scans and wheels: what each number is."""

import numpy as np
import pytest
import yaml

from sceneslam.modules.detectors.features import (
    corner_count,
    depth_noise_ratio,
    depth_ratio,
    scan_hold,
    scan_near_ratio,
    scan_return_ratio,
    usable_ratio,
)
from sceneslam.modules.detectors.image_features import ImageFeatures
from sceneslam.modules.detectors.image_health import (
    Flicker,
    Tears,
    grey_peak,
    overexposed_ratio,
    sharpness,
)
from sceneslam.modules.detectors.learned import Learned
from sceneslam.modules.detectors.silence import Frozen, Silent
from sceneslam.modules.detectors.wheel_check import WheelCheck
from sceneslam.testing.floor_plans import Scanner, World, box
from sceneslam.types import planar
from sceneslam.types.observation import UNSURE, LaserScan, Observation
from sceneslam.types.rig import Laser, Rig, Sensor

S = 10**9


def grey(values):
    """Return an image (H, W, 3) of grey values (H, W)."""
    return np.repeat(np.asarray(values, np.uint8)[..., None], 3, axis=2)


def test_pixels_are_usable_from_16_to_239_and_overexposed_from_250():
    image = grey([[15, 16, 239, 240], [0, 100, 249, 250]])
    assert usable_ratio(image) == 3 / 8 and overexposed_ratio(image) == 1 / 8


def test_the_peak_is_the_grey_value_that_one_pixel_in_a_thousand_exceeds():
    image = np.zeros((200, 200), np.uint8)
    image[::2, ::2] = 40
    image[:2, :18:2] = 90  # 9 of the 10000 that are examined
    assert grey_peak(grey(image)) == 40.0
    image[:2, :24:2] = 90
    assert grey_peak(grey(image)) == 90.0


def test_corners_are_counted_per_hundred_pixels_squared():
    image = np.full((200, 300), 50, np.uint8)
    image[50:200:50, 60:300:60] = 250  # 12 bright dots
    assert corner_count(grey(image)) == pytest.approx(2.0)
    assert corner_count(grey(np.full((90, 90), 50))) == 0.0


def test_depth_noise_is_counted_in_the_middle_of_the_image():
    depth_m = np.full((40, 80), 2.0, np.float32)
    depth_m[5, 40] = depth_m[20, 10] = depth_m[20, 70] = depth_m[35, 40] = 9.0  # outside
    assert depth_noise_ratio(depth_m) == 0.0 and depth_ratio(depth_m) == 1.0
    for row, column in ((12, 22), (27, 57), (20, 40)):  # within, the corners too
        depth_m[row, column] = 2.3
    count = 18 * 38  # without the border, whose neighbours are outside
    assert depth_noise_ratio(depth_m) == pytest.approx(3 / count)
    depth_m[20, 40], depth_m[20, 41] = 2.3, 2.3  # a surface of two pixels
    assert depth_noise_ratio(depth_m) == pytest.approx(2 / count)
    depth_m[20, 40:42] = 0.0
    assert depth_noise_ratio(depth_m) == pytest.approx(2 / (count - 2))
    assert depth_noise_ratio(np.zeros((40, 80), np.float32)) == 0.0
    assert depth_ratio(depth_m) == 1.0 - 2 / 3200


def scan_of(ranges_m):
    return LaserScan(
        stamp_ns=0,
        ranges_m=np.asarray(ranges_m, np.float32),
        angle_min_rad=-1.0,
        angle_step_rad=2.0 / (len(ranges_m) - 1),
        range_min_m=0.1,
        range_max_m=9.0,
    )


def test_beams_return_and_end_on_the_window():
    scan = scan_of([0.15, 0.19, 0.21, 5.0, np.inf, np.inf, np.inf, 1.0])
    assert scan_near_ratio(scan) == 2 / 8 and scan_return_ratio(scan) == 5 / 8


def test_a_wall_holds_one_direction_and_a_corner_both():
    angles = np.linspace(-1.0, 1.0, 401)
    wall = 1.0 / np.cos(angles)
    assert scan_hold(scan_of(wall)) == pytest.approx(0.0, abs=1e-3)
    both = np.where(angles < 0, 1.0 / np.cos(angles + 0.785), 1.0 / np.cos(angles - 0.785))
    assert scan_hold(scan_of(both)) == pytest.approx(1.0, abs=0.1)
    assert scan_hold(scan_of(np.full(401, np.inf))) == 0.0


def edges(blur_px, noise=0.0, width=480):
    """Bars of a twelfth of the width, whose edges are that wide."""
    x = np.arange(width)
    bars = 128.0 + 60.0 * np.clip(np.sin(x * 12 * np.pi / width) * 40.0 / max(blur_px, 1), -1, 1)
    image = np.tile(bars, (120, 1))
    return grey(np.clip(image + np.random.default_rng(0).normal(0, noise, image.shape), 0, 255))


def test_sharpness_is_one_for_steps_and_small_for_edges_out_of_focus():
    sharp, blurred = (sharpness(edges(blur_px)) for blur_px in (1, 30))
    assert sharp > 0.9 and 0.2 < blurred < 0.6
    assert sharpness(edges(30, noise=3.0)) == pytest.approx(blurred, abs=0.15)
    assert sharpness(grey(np.full((120, 480), 90))) == 1.0


def look(measure, images, step_s=0.1):
    """Return what a feature says after each image."""
    return [
        measure(Observation(stamp_ns=round(step_s * index * S), image_bgr=image))
        for index, image in enumerate(images)
    ]


def test_cuts_of_an_image_are_counted_over_five_images():
    whole = np.tile(np.linspace(20, 220, 160), (100, 1))
    cut = whole.copy()
    cut[40:] = np.roll(whole, 40, axis=1)[40:]
    twice = cut.copy()
    twice[70:] = whole[70:]
    assert look(Tears(), [grey(whole), grey(cut), grey(whole), grey(twice)]) == [0, 1, 0.5, 1.0]
    # A cut that stays where it was is an edge of the scene.
    assert look(Tears(), [grey(cut)] * 3) == [0.0, 0.0, 0.0]
    images = [grey(whole), grey(cut)] + [grey(whole)] * 5
    assert look(Tears(), images)[-2:] == [0.2, 0.0]
    assert look(Tears(), [grey(whole), None, grey(whole[:50])]) == [0.0] * 3


def test_flicker_is_counted_in_full_periods_of_the_last_second():
    bright, dim = grey(np.full((8, 8), 200)), grey(np.full((8, 8), 120))
    images = [bright if index // 2 % 2 else dim for index in range(21)]  # 2.5 Hz
    assert look(Flicker(), images)[-1] == pytest.approx(2.5, abs=0.5)
    assert look(Flicker(), [bright] * 20)[-1] == 0.0
    little = grey(np.full((8, 8), 155))  # 0.35 powers of two
    assert look(Flicker(), [little, bright] * 10)[-1] == 0.0
    enough = grey(np.full((8, 8), 149))  # 0.41
    assert look(Flicker(), [enough, bright] * 10)[-1] > 4.0
    assert look(Flicker(), [*images, *[dim] * 11])[-1] == 0.0


def test_a_sensor_is_silent_since_its_last_measurement_and_frozen_while_it_repeats():
    silent, frozen = (kind(lambda one: one.image_bgr) for kind in (Silent, Frozen))
    first, second = grey(np.zeros((4, 4))), grey(np.ones((4, 4)))
    images = [first, first.copy(), None, first, second, None, None]
    for measure, expected in (
        (silent, [0.0, 0.0, 0.5, 0.0, 0.0, 0.5, 1.0]),
        (frozen, [0.0, 0.5, 0.5, 1.5, 0.0, 0.0, 0.0]),
    ):
        assert look(measure, images, step_s=0.5) == pytest.approx(expected)


ROOM = World(box(-2.0, -1.5, 3.0, 2.5), np.random.default_rng(0), Scanner(noise_m=0.005))


def wheel_ratio(step, told, count=12):
    """Return the ratio after a drive of steps (3,), of which the wheels report others."""
    check = WheelCheck(Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser()))
    pose = wheels = np.zeros(3)
    for index in range(count):
        stamp_ns = round(0.1 * index * S)
        ratio = check(
            Observation(
                stamp_ns=stamp_ns,
                scan=ROOM.scan(pose, stamp_ns),
                T_odom_base=planar.to_transform(wheels),
            )
        )
        pose, wheels = planar.compose(pose, np.array(step)), planar.compose(wheels, np.array(told))
    return ratio


@pytest.mark.parametrize(
    ("step", "told", "ratio"),
    [
        ((0.05, 0, 0.03), (0.05, 0, 0.03), 1.0),
        ((0.0, 0, 0.0), (0.0, 0, 0.0), 1.0),
        ((0.0, 0, 0.0), (0.08, 0, 0.0), 0.0),
        ((0.04, 0, 0.0), (0.08, 0, 0.0), 0.5),
        ((-0.05, 0, 0.0), (0.05, 0, 0.0), -1.0),
        ((0.06, 0, 0.0), (0.0, 0, 0.0), 10.0),
        ((0.05, 0, 0.06), (0.1, 0, 0.06), 0.5),
    ],
)
def test_the_ratio_of_true_motion_to_the_wheels_is_measured_by_scans(step, told, ratio):
    assert wheel_ratio(step, told) == pytest.approx(ratio, abs=0.15)


def test_a_model_votes_by_softmax_of_its_scaled_features(tmp_path):
    model = {
        "scenes": ["Bright", "Dark"],
        "features": ["grey_mean", "usable_ratio"],
        "mean": [100.0, 0.5],
        "scale": [20.0, 0.25],
        "weights": {"Bright": [1.0, 0.5], "Dark": [-1.0, 0.25]},
        "bias": {"Bright": 0.25, "Dark": -0.5},
    }
    (tmp_path / "model.yaml").write_text(yaml.safe_dump(model))
    learned = Learned(str(tmp_path / "model.yaml"))
    vote = learned.decide(5, np.array([90.0, 1.0]))
    logits = np.array([-0.5 + 1.0 + 0.25, 0.5 + 0.5 - 0.5])
    share = 1.0 / (1.0 + np.exp(logits[1] - logits[0]))
    assert (vote.scene, vote.stamp_ns) == ("Bright", 5)
    assert vote.value == pytest.approx(share)
    assert vote.likelihoods["Dark"] == pytest.approx(1.0 - share)
    assert learned.decide(5, np.array([np.nan, 1.0])).scene == UNSURE
    assert learned.decide(5, None).scene == UNSURE


def test_image_features_are_quantiles_shares_texture_and_colour():
    values = np.repeat(np.arange(0, 200, 2)[:, None], 100, axis=1)  # each 1 % of the image
    values[:, 1::2] = values[:, 1::2] + 1
    values[95:] = 251
    names = ["q10", "q25", "q50", "q75", "q90", "dark", "white", "gradient", "colour"]
    found = ImageFeatures(names).get_features(Observation(stamp_ns=0, image_bgr=grey(values)))
    quantiles = [np.log2((one + 4.0) / 259.0) for one in (19, 49, 99, 149, 179)]
    np.testing.assert_allclose(found[:5], quantiles, atol=0.01)
    assert found[5:7] == pytest.approx([0.085, 0.05])
    assert found[7] == pytest.approx(np.log2(1.0 + 0.95), abs=0.01) and found[8] == 0.0
    half = np.zeros((4, 4, 3), np.uint8)
    half[..., 2], half[..., :2] = 200, 100
    (colour,) = ImageFeatures(["colour"]).get_features(Observation(stamp_ns=0, image_bgr=half))
    assert colour == pytest.approx(0.5, abs=0.01)
