"""Features of images, depth and scans: what each number is."""

from dataclasses import replace

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
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import UNSURE, LaserScan, Observation
from sceneslam.types.rig import Sensor

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


def test_depth_noise_differs_from_its_neighbours_by_more_than_a_tenth():
    for beside_m, count in ((9.0, 0), (8.99, 1), (11.0, 0), (11.01, 1)):
        depth_m = np.full((20, 20), beside_m, np.float32)
        depth_m[10, 10] = 10.0
        assert depth_noise_ratio(depth_m) == pytest.approx(count / 64)


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


@pytest.mark.parametrize(("radius_m", "hold"), [(0.86, 1.0), (0.87, 0.0)])
def test_returns_farther_apart_than_30_cm_are_of_different_surfaces(radius_m, hold):
    # The chord over 4 of 72 beams is 2 r sin(10 degrees); a circle has normals in all directions.
    scan = LaserScan(
        stamp_ns=0,
        ranges_m=np.full(76, radius_m, np.float32),
        angle_min_rad=0.0,
        angle_step_rad=2 * np.pi / 72,
        range_min_m=0.1,
        range_max_m=9.0,
    )
    assert scan_hold(scan) == pytest.approx(hold, abs=1e-5)


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


def profile(steps, scale, rows):
    """Return an image of equal rows with steps {column: height} of grey values, in a scale."""
    values = np.full(240, 100)
    for column, height in steps.items():
        values[column:] += height
    return grey(np.tile(np.repeat(values, scale), (rows * scale, 1)))


@pytest.mark.parametrize("scale", [1, 2, 3])
@pytest.mark.parametrize("sign", [1, -1])
def test_sharpness_compares_the_largest_step_within_a_240th_with_that_of_a_40th(scale, sign):
    # Only over the columns 99 to 105 is the height above 24; the step at 106 is beyond them.
    steps = {100: sign * 6, 105: sign * 20, 106: sign * -22}
    assert sharpness(profile(steps, scale, 80)) == pytest.approx(20 / 26)
    first = {99: sign * -22, 100: sign * 20, 105: sign * 6}
    assert sharpness(profile(first, scale, 80)) == pytest.approx(20 / 26)
    halo = {100: sign * 50, 102: sign * -20}
    assert sharpness(profile(halo, scale, 80)) == 1.0


def test_edges_are_above_24_grey_values_in_40_pixels_or_more():
    steps = {100: 5, 105: 20, 106: -22}  # 25 in one column of each second row
    assert sharpness(profile(steps, 1, 80)) == pytest.approx(20 / 25)
    assert sharpness(profile(steps, 1, 78)) == 1.0
    assert sharpness(profile({100: 4, 105: 20, 106: -22}, 1, 80)) == 1.0


def test_sharpness_is_that_of_the_mean_of_three_rows():
    image = np.full((99, 240), 100)
    for row in range(3):
        image[row::3, 100 + 2 * row :] += 72
    # The mean has three steps of 24 two pixels apart: edges are two or three of them.
    assert sharpness(grey(image)) == pytest.approx(1 / 2)


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


def image_features(image_bgr, *names):
    return ImageFeatures(names).get_features(Observation(stamp_ns=0, image_bgr=image_bgr))


def test_image_features_are_quantiles_shares_texture_and_colour():
    ramp = grey(np.tile(np.arange(256), (100, 1)))  # one column of each grey value
    percents = np.array([10, 25, 50, 75, 90, 98])
    levels = np.ceil(256 * percents / 100) - 1  # the first that as many do not exceed
    found = image_features(ramp, *(f"q{percent}" for percent in percents))
    np.testing.assert_allclose(found, np.log2((levels + 4) / 259))
    found = image_features(ramp, "dark", "white", "gradient", "colour")
    assert found == pytest.approx([17 / 256, 5 / 256, np.log2(1 + 1), 0.0])
    assert image_features(ramp[:, ::-3], "gradient") == pytest.approx(np.log2(1 + 3))
    assert image_features(ramp.transpose(1, 0, 2), "gradient") == pytest.approx(0.0)
    half = np.zeros((4, 4, 3), np.uint8)
    half[..., 2], half[..., :2] = 255, 51
    assert image_features(half, "colour") == pytest.approx(0.8)


def test_image_features_are_of_a_grid_of_96_rows_or_more():
    image = np.zeros((300, 192), np.uint8)
    image[::2, ::2] = 200
    assert image_features(grey(image), "dark") == pytest.approx(0.0)
    assert image_features(grey(image[:, :191]), "dark") == pytest.approx(0.75, abs=0.01)


def test_image_features_have_known_names_that_differ():
    for names in ([], ["q51"], ["q50", "q50"]):
        with pytest.raises(ConfigError) as caught:
            ImageFeatures(names)
        assert caught.value.key == "names"
    features = ImageFeatures(["q50", "depth_ratio"])
    assert features.requires == (frozenset({Sensor.IMAGE, Sensor.DEPTH}),)
    observation = Observation(stamp_ns=0, image_bgr=grey([[0]]))
    assert features.get_features(observation) is None
    observation = replace(observation, depth_m=np.array([[1.0, 0.0]], np.float32))
    np.testing.assert_allclose(features.get_features(observation), [np.log2(4 / 259), 0.5])
