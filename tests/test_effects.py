"""The light is switched off: noise as in a camera, everything else untouched."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra import compose, initialize_config_module
from hydra.utils import get_class
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf
from ros_recordings import make_source
from test_source_ordered import Listed

from sceneslam.interfaces import Source
from sceneslam.sources.changes.dim_sensor import DimSensor
from sceneslam.sources.changes.effects import LightsOut
from sceneslam.sources.changes.light_schedule import LightSchedule
from sceneslam.sources.spanned import TimeSpan
from sceneslam.testing.room import RIG
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.truth import GroundTruth, SceneChange

_CONF = Path(__file__).resolve().parents[1] / "conf" / "effects" / "lights_out.yaml"
GREY = np.full((200, 300, 3), 130, np.uint8)
DEPTH = np.ones((200, 300), np.float32)


class Film(Listed):
    """Ten seconds of one image at 10 Hz."""

    scenes: tuple[SceneChange, ...] = ()

    @property
    def span(self) -> TimeSpan:
        return TimeSpan(
            start_ns=self.observations[0].stamp_ns, end_ns=self.observations[-1].stamp_ns
        )

    def ground_truth(self) -> GroundTruth:
        return GroundTruth(scenes=self.scenes)


def film(image_bgr: np.ndarray = GREY) -> Film:
    return Film(
        [
            Observation(stamp_ns=5 * 10**9 + index * 10**8, image_bgr=image_bgr, depth_m=DEPTH)
            for index in range(101)
        ],
        rig=RIG,
    )


def lights_out(source: Source, **changes: Any) -> LightsOut:
    config: Any = OmegaConf.to_container(OmegaConf.load(_CONF), resolve=False)
    config |= {"lights": "story", "seed": 3, **changes}
    made = get_class(config.pop("_target_"))(source, **config)
    assert isinstance(made, LightsOut)
    return made


def sensor(gain_max: float = 1.0) -> DimSensor:
    return DimSensor(full_well_electrons=8000.0, read_noise_electrons=6.0, gain_max=gain_max)


def linear(value: np.ndarray | float) -> np.ndarray:
    share = np.asarray(value) / 255.0
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def test_the_light_goes_off_half_way_and_depth_stays() -> None:
    source = film()
    found = list(lights_out(source))
    means = np.array([one.image_bgr.mean() for one in found])
    assert (means[:50] == 130).all()
    assert (means[56:] < 30).all()
    assert all(one.depth_m is DEPTH for one in found)
    assert not found[-1].image_bgr.flags.writeable


def test_full_light_leaves_the_observation_untouched() -> None:
    source = film()
    assert all(a is b for a, b in zip(lights_out(source, lights="on"), source, strict=True))


def test_the_same_seed_gives_the_same_noise_and_frames_differ() -> None:
    first, second = (list(lights_out(film(), lights="off")) for _ in range(2))
    other = list(lights_out(film(), lights="off", seed=4))
    assert all((a.image_bgr == b.image_bgr).all() for a, b in zip(first, second, strict=True))
    assert (first[0].image_bgr != first[1].image_bgr).any()
    assert (first[0].image_bgr != other[0].image_bgr).any()


def test_the_true_scene_is_dark_while_less_than_half_the_light_is_on() -> None:
    start_ns = 5 * 10**9
    found = lights_out(film(), fade_s=1.0).ground_truth().scenes
    assert found == (
        SceneChange(stamp_ns=start_ns, scene="Bright"),
        SceneChange(stamp_ns=start_ns + 5_500_000_000, scene="Dark"),
    )
    there_and_back = [[0.0, 0.0], [2.0, 1.0], [7.0, 0.4]]
    effect = lights_out(film(), schedule=there_and_back, schedule_unit="seconds", fade_s=0.0)
    assert [change.scene for change in effect.ground_truth().scenes] == ["Dark", "Bright", "Dark"]


def test_scenes_that_the_source_knows_stay_where_the_light_is_on() -> None:
    source = film()
    source.scenes = (
        SceneChange(stamp_ns=5 * 10**9, scene="Indoor"),
        SceneChange(stamp_ns=7 * 10**9, scene="Outdoor"),
    )
    scenes = [change.scene for change in lights_out(source).ground_truth().scenes]
    assert scenes == ["Indoor", "Outdoor", "Dark"]


def test_lights_on_or_off_hold_throughout() -> None:
    assert [c.scene for c in lights_out(film(), lights="off").ground_truth().scenes] == ["Dark"]
    assert [c.scene for c in lights_out(film(), lights="on").ground_truth().scenes] == ["Bright"]


@pytest.mark.parametrize("light", [0.5, 0.1, 0.02])
def test_mean_and_noise_are_those_of_counted_electrons(light: float) -> None:
    rng = np.random.default_rng(0)
    found = linear(sensor().dim(GREY, light, rng)) * 8000.0
    electrons = float(linear(130.0)) * 8000.0 * light
    assert found.mean() == pytest.approx(electrons, rel=0.03)
    step = 8000.0 * np.diff(linear(np.arange(256.0)))  # electrons per grey value
    near = np.argmin(np.abs(8000.0 * linear(np.arange(256.0)) - electrons))
    expected = electrons * (1 - light) + 36.0 * (1 - light**2) + step[near] ** 2 / 12
    assert found.std() == pytest.approx(np.sqrt(expected), rel=0.1)


def test_few_electrons_are_poisson_distributed() -> None:
    image = np.full((400, 400, 3), 60, np.uint8)
    light, rng = 0.005, np.random.default_rng(1)
    mean = float(linear(60.0)) * 8000.0 * light
    assert mean < 3
    noiseless = DimSensor(full_well_electrons=8000.0, read_noise_electrons=0.0, gain_max=1000.0)
    found = noiseless.dim(image, light, np.random.default_rng(0))
    # Exposure makes up for all of the light, so that one electron is a large step.
    counts = rng.poisson(mean * (1 - light), image.size) + mean * light
    levels = linear(np.arange(256) + 0.5)[:-1] * 8000.0 * light
    expected = np.bincount(np.digitize(counts, levels), minlength=256) / image.size
    seen = np.bincount(found.ravel(), minlength=256) / image.size
    np.testing.assert_allclose(np.cumsum(seen), np.cumsum(expected), atol=0.02)


def test_exposure_holds_the_brightness_as_far_as_its_gain_goes() -> None:
    rng = np.random.default_rng(0)
    assert sensor(8.0).dim(GREY, 0.25, rng).mean() == pytest.approx(130, abs=1)
    assert sensor(8.0).dim(GREY, 0.01, rng).mean() < 60
    assert sensor(8.0).dim(GREY, 0.25, rng).std() > sensor(1.0).dim(GREY, 0.25, rng).std()


def test_black_stays_black_and_white_does_not_overflow() -> None:
    black, white = np.zeros((9, 9, 3), np.uint8), np.full((9, 9, 3), 255, np.uint8)
    rng = np.random.default_rng(0)
    assert sensor().dim(black, 0.5, rng).max() <= 12
    assert sensor(8.0).dim(white, 0.5, rng).min() > 200


def test_a_real_recording_becomes_as_dark_as_real_dark_images(shared_data: Path) -> None:
    source = make_source("tum_rgbd", shared_data / "tum_fr1_rpy")
    first = next(iter(lights_out(source, lights="off")))
    assert first.image_bgr.mean() < 30


@given(
    st.lists(st.tuples(st.floats(0, 10), st.floats(0, 1)), min_size=1, max_size=6),
    st.floats(0, 3),
)
def test_levels_stay_between_off_and_on(steps: list[tuple[float, float]], fade_s: float) -> None:
    rising = sorted(dict(steps).items())
    schedule = LightSchedule.of_steps(rising, unit_s=1.0, fade_s=fade_s)
    levels = [schedule.level(time) for time in np.linspace(0, 20, 101)]
    assert all(0 <= level <= 1 for level in levels)
    assert schedule.level(20.0) == pytest.approx(rising[-1][1])


@pytest.mark.parametrize(
    ("key", "changes"),
    [
        ("schedule", {"schedule": []}),
        ("schedule", {"schedule": [[0.5, 0.0], [0.2, 1.0]]}),
        ("schedule", {"schedule": [[0.0, 2.0]]}),
        ("schedule", {"schedule": [[3.0, 0.0]]}),
        ("schedule", {"schedule": ["off"]}),
        ("schedule_unit", {"schedule_unit": "frames"}),
        ("lights", {"lights": "dim"}),
        ("fade_s", {"fade_s": -1.0}),
        ("ambient_ratio", {"ambient_ratio": 2.0}),
        ("full_well_electrons", {"full_well_electrons": 1.0}),
        ("read_noise_electrons", {"read_noise_electrons": -1.0}),
        ("exposure_gain_max", {"exposure_gain_max": 0.5}),
        ("seed", {"seed": -1}),
    ],
)
def test_wrong_values_are_named_by_their_key(key: str, changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as caught:
        lights_out(film(), **changes)
    assert caught.value.key == key


def test_shares_need_a_source_that_knows_its_duration() -> None:
    with pytest.raises(ConfigError, match="schedule_unit"):
        lights_out(Listed([], rig=RIG))
    assert list(lights_out(Listed([], rig=RIG), schedule_unit="seconds")) == []


EVERY = sorted(path.stem for path in _CONF.parent.glob("*.yaml") if path.stem != "none")
ON_ANYTHING = {"faults", "laps"}


@pytest.mark.parametrize("name", EVERY)
def test_an_effect_on_a_sensor_that_the_source_lacks_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "times.txt").write_text("5.0 0.01\n")
    words = [f"effects={name}", "seed=1", "+effects.source=null"]
    words += [f"effects.path={tmp_path}/times.txt"] if name == "exposure_times" else []
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        node: Any = OmegaConf.to_container(compose("config", overrides=words).effects, resolve=True)
    make = get_class(node.pop("_target_"))
    assert make(**node | {"source": film()})
    lidar = Listed([], rig=Rig(sensors=frozenset({Sensor.POINTS})))
    if name in ON_ANYTHING:
        assert make(**node | {"source": lidar})
        return
    with pytest.raises(ConfigError, match="allowed: with a source that has"):
        make(**node | {"source": lidar})
