"""Check of a source: its sensors, which modules can run on it, and the command for a run."""

from __future__ import annotations

import difflib
import logging
import re
from collections.abc import Iterator, Sequence
from importlib.resources import files
from typing import Any

from sceneslam.config.build import opened_source
from sceneslam.config.check import TOP_LEVEL, check_given, first_line
from sceneslam.config.component import ComponentBuilder
from sceneslam.config.words import is_override
from sceneslam.interfaces import Live, SlamModule
from sceneslam.script import composed
from sceneslam.sources.survey.preflight import Preflight, preflight
from sceneslam.sources.survey.survey import Surveyed
from sceneslam.types.errors import ConfigError, InputError, text_of
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.se3 import Transform

_log = logging.getLogger(__name__)
_KEY = "slam.only"
_BOTH = (  # scenarios and required sensors; the first that fits is proposed
    ("+scenario=bright_to_dark", {Sensor.IMAGE, Sensor.DEPTH}),
    ("+scenario=single slam@slam.only=laser", {Sensor.SCAN}),
    ("+scenario=single slam@slam.only=depth", {Sensor.DEPTH}),
    ("+scenario=single slam@slam.only=kiss_icp", {Sensor.POINTS}),
    ("+scenario=single slam@slam.only=odometry", {Sensor.ODOMETRY}),
)


def examine(words: Sequence[str]) -> list[str]:
    """Return the lines of `python -m sceneslam doctor source=NAME [source.KEY=VALUE ...]`.

    Words for other keys, as of a command that is to be run, have no effect. Raises ConfigError for
    a word that is none, ConfigError or InputError if the source cannot be read.
    """
    for word in words:
        _check_word(word)
    if not any(word.startswith("source=") for word in words):
        raise ConfigError("doctor", " ".join(words) or "nothing", "source=NAME, as source=ros2")
    words = [word for word in words if _key_of(word) in ("source", "effects")]
    config: dict[str, Any] = composed(tuple(words), None)
    for key in ("source", "effects"):
        check_given(config.get(key), key)
    with opened_source(config, ComponentBuilder(config)) as source:
        is_live = isinstance(source, Live) and source.live is not None
        rig = source.rig
        survey = source.survey() if isinstance(source, Surveyed) else None
        found = Preflight(lines=(), warnings=()) if survey is None else preflight(survey, rig)
    return [
        *(found.lines or [f"sensors: {', '.join(_named(rig.sensors))}"]),
        *(f"warning: {one}" for one in found.warnings),
        "",
        *_places(rig),
        "",
        *_modules(words, rig),
        "",
        *_proposal(words, rig, is_live=is_live),
    ]


def _key_of(word: str) -> str:
    """Return the top-level key that a word of the command line sets."""
    return re.split(r"[=.@]", word.lstrip("+~"), maxsplit=1)[0]


def _check_word(word: str) -> None:
    """Raise ConfigError for a word of the command line that sets no known key."""
    key, known = _key_of(word), (*TOP_LEVEL, "scenario", "experiment")
    if not is_override(word) or key not in known:
        close = difflib.get_close_matches(key, known, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise ConfigError("doctor", word, f"source=NAME, source.KEY=VALUE, effects=NAME{hint}")


def _places(rig: Rig) -> Iterator[str]:
    """Yield the poses of the sensors on the robot."""
    mounts: dict[str, Transform | None] = {
        "camera": rig.camera.T_base_cam if rig.camera else None,
        "laser": rig.laser.T_base_laser if rig.laser else None,
        "lidar": rig.lidar.T_base_lidar if rig.lidar else None,
    }
    for name, T_base_sensor in mounts.items():
        if T_base_sensor is not None:
            x, y, z = T_base_sensor[:3, 3]
            forward = T_base_sensor[:3, 2 if name == "camera" else 0]
            looks = ", ".join(f"{value:.2f}" for value in forward)
            yield f"{name:8} at ({x:.2f}, {y:.2f}, {z:.2f}) m in base, looks along ({looks})"
    if rig.camera is not None:
        camera = rig.camera
        width, height = camera.size_wh
        yield (
            f"camera   {width}x{height}, fx {camera.fx:.1f}, fy {camera.fy:.1f}, "
            f"cx {camera.cx:.1f}, cy {camera.cy:.1f} px"
        )


def _modules(words: Sequence[str], rig: Rig) -> Iterator[str]:
    """Yield for every SLAM module whether it can run, or which sensors are missing."""
    names = sorted(path.name for path in files("sceneslam.conf").joinpath("slam").iterdir())
    for name in (one.removesuffix(".yaml") for one in names if one.endswith(".yaml")):
        try:
            config: dict[str, Any] = composed(
                ("+scenario=single", *words, f"slam@{_KEY}={name}"), None
            )
            requires = ComponentBuilder(config).make(_KEY, SlamModule).requires
        except (ConfigError, InputError) as error:
            _log.debug("slam=%s: %s", name, text_of(error))
            yield f"{name:12} not tried: {first_line(error)}"
            continue
        lacking = [sensors - rig.sensors for sensors in requires]
        if not all(lacking):
            yield f"{name:12} can run"
        else:
            needs = ", or ".join(" and ".join(_named(one)) for one in lacking)
            yield f"{name:12} lacks {needs}"


def _proposal(words: Sequence[str], rig: Rig, *, is_live: bool) -> Iterator[str]:
    scenario = next((text for text, needs in _BOTH if needs <= rig.sensors), None)
    if scenario is None:
        yield "no SLAM module can run on this"
        return
    more = ["run=live"] if is_live else []
    if is_live and [word for word in words if word.startswith("source=")][-1] == "source=ros2":
        more.append("+sinks@sinks.ros2=ros2")
    yield "run it with:"
    yield "  " + " ".join(["python -m sceneslam", scenario, *words, *more])


def _named(sensors: frozenset[Sensor]) -> list[str]:
    return [sensor.value for sensor in Sensor if sensor in sensors]
