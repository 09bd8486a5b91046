"""Exposure: what sources report of it, and the detector that uses it."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from test_effects import film, lights_out

from sceneslam.modules.detectors.light_mean import LightMean, light_mean
from sceneslam.sources.changes.exposure_times import ExposureTimes
from sceneslam.types.errors import ConfigError, InputError

GREY = np.random.default_rng(0).integers(100, 161, (120, 160, 3), dtype=np.uint8)


def detector() -> LightMean:
    made = LightMean(threshold=100.0, hysteresis=0.0, scenes=("Bright", "Dark"))
    made.activate(film().rig)
    return made


def test_light_is_the_image_where_nothing_is_known_of_its_exposure():
    assert light_mean(GREY, 1.0) == pytest.approx(130.0, abs=0.5)


@pytest.mark.parametrize("exposure_ratio", [0.25, 0.5, 2.0, 8.0])
def test_exposure_scales_light_and_not_grey_values(exposure_ratio):
    share = (130.0 / 255 + 0.055) / 1.055
    expected = 255 * (1.055 * (share**2.4 / exposure_ratio) ** (1 / 2.4) - 0.055)
    image = np.full((120, 160, 3), 130, np.uint8)
    assert light_mean(image, exposure_ratio) == pytest.approx(min(expected, 255.0), abs=0.5)


def test_a_saturated_pixel_is_as_bright_as_it_has_to_be_at_least():
    white = np.full((120, 160, 3), 255, np.uint8)
    assert light_mean(white, 0.25) == pytest.approx(255.0)
    assert light_mean(white, 4.0) == pytest.approx(137.0, abs=0.5)


def test_automatic_exposure_hides_darkness_from_the_image_alone():
    """Three quarters of the light are gone; the exposure makes up for all of it."""
    source = lights_out(film(GREY), lights="off", ambient_ratio=0.25, exposure_gain_max=4.0)
    votes = [detector().get_scene(one) for one in source]
    assert {vote.scene for vote in votes} == {"Dark"}
    unaware = [detector().get_scene(replace(one, exposure_ratio=None)) for one in source]
    assert {vote.scene for vote in unaware} == {"Bright"}


def test_exposures_of_a_file_reach_the_images(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "times.txt").write_text("# stamp_s exposure_s gain\n5.0 0.01 1\n5.5 0.02 4\n")
    effect = ExposureTimes(film(), path="~/times.txt", reference_s=0.01)
    ratios = [one.exposure_ratio for one in islice(effect, 6)]
    assert ratios[0] == 1.0 and ratios[2] == 1.0 and ratios[-1] == pytest.approx(8.0)
    assert effect.ground_truth() is not None and effect.faults == []


def test_image_that_the_file_does_not_list_keeps_its_exposure_and_is_a_fault(tmp_path):
    (tmp_path / "times.txt").write_text("5.0 0.01\n5.5 0.02\n")
    effect = ExposureTimes(film(), path=str(tmp_path / "times.txt"), reference_s=0.01)
    for _ in range(2):
        ratios = [one.exposure_ratio for one in effect]
        assert ratios[15] == pytest.approx(2.0) and ratios[16:] == [None] * 85
        (fault,) = effect.faults
        assert "image without an exposure within 1 s" in fault and "85 times" in fault
        assert "first at stamp 6.600000 s" in fault


@pytest.mark.parametrize("stamp_s", [1.7e9, 3.9, 16.1])
def test_file_of_exposures_on_another_clock_is_refused(tmp_path, stamp_s):
    (tmp_path / "times.txt").write_text(f"{stamp_s} 0.01\n")
    with pytest.raises(InputError, match=r"5\.000 to 15\.000 s, have no time in common.*times"):
        ExposureTimes(film(), path=str(tmp_path / "times.txt"), reference_s=None)


@pytest.mark.parametrize("text", ["", "5.0\n", "5.0 0.01 1 2\n", "5.0 0\n", "6 1\n5 1\n", "a b\n"])
def test_wrong_file_of_exposures_is_refused_in_one_sentence(tmp_path, text):
    (tmp_path / "times.txt").write_text(text)
    with pytest.raises(InputError, match=r"expected lines `stamp_s exposure_s`.*times\.txt"):
        ExposureTimes(film(), path=str(tmp_path / "times.txt"), reference_s=None)
    with pytest.raises(InputError, match="a path is empty"):
        ExposureTimes(film(), path="", reference_s=None)
    with pytest.raises(InputError, match="not found"):
        ExposureTimes(film(), path=str(tmp_path / "nothing.txt"), reference_s=None)
    with pytest.raises(ConfigError, match="reference_s"):
        ExposureTimes(film(), path=str(tmp_path / "times.txt"), reference_s=0.0)
