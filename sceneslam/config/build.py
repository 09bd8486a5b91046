"""Building of all parts of a run from its configuration, with checks that they fit together."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from sceneslam.atlas.atlas import Atlas
from sceneslam.bus.policy import Policy
from sceneslam.config.check import NOTHING, check_keys
from sceneslam.config.component import ComponentBuilder
from sceneslam.config.echo import check_echo
from sceneslam.config.settings import DETECT_ONLY, LIVE, RunSettings
from sceneslam.evaluation.settings import EvaluationSettings
from sceneslam.interfaces import Detector, Live, LiveFeed, Sink, SlamModule, Source
from sceneslam.sources.contract.ordered import Ordered
from sceneslam.sources.contract.rising_live import RisingLive
from sceneslam.supervision.isolated import IsolatedModule
from sceneslam.types.errors import ConfigError, ModuleError, text_of
from sceneslam.types.rig import Rig, Sensor

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunParts:
    """All parts of a run."""

    source: Source
    rig: Rig
    detector: Detector
    modules: Mapping[str, SlamModule]
    scenes: Mapping[str, Sequence[str]]
    policy: Policy
    atlas: Atlas
    sinks: Mapping[str, Sink]
    evaluation: EvaluationSettings
    run: RunSettings

    def close(self) -> None:
        """End the processes of modules with a process of their own, and close a live source."""
        for module in self.modules.values():
            if isinstance(module, IsolatedModule):
                module.close()
        _release(self.source)


def build(config: Mapping[str, Any]) -> RunParts:
    """Return all parts; raises ConfigError or InputError that names what does not fit."""
    check_keys(config)
    builder = ComponentBuilder(config)
    run = builder.make("run", RunSettings)
    if run.mode == DETECT_ONLY:
        raise ConfigError("run.mode", run.mode, "recording | live, where modules run")
    policy = builder.make("policy", Policy)
    detector = builder.make("detector", Detector)
    scenes = _table(config, detector)
    modules = {key: _module(builder, run, key) for key in _used(scenes)}
    requires = {key: _requires(module, f"slam.{key}") for key, module in modules.items()}
    for key in set(policy.startup_s) - set(modules):
        known = f"a key of slam that a scene names: {', '.join(modules)}"
        raise ConfigError(f"policy.startup_s.{key}", policy.startup_s[key], known)
    atlas = builder.make("atlas", Atlas)
    evaluation = make_evaluation(builder, detector)
    sinks = {key: builder.make(f"sinks.{key}", Sink) for key in _group(config, "sinks")}
    check_echo({key: config["slam"][key] for key in modules}, _group(config, "sinks"))
    source = make_source(config, builder)
    with ExitStack() as opened:  # closed again if it does not fit
        opened.callback(_release, source)
        check_mode(run, source)
        rig = source.rig
        check_detector(config, detector, rig)
        for key in modules:
            _check_sensors(f"slam.{key}", config["slam"][key], requires[key], rig)
        opened.pop_all()
    return RunParts(
        source=source,
        rig=rig,
        detector=detector,
        modules=modules,
        scenes=scenes,
        policy=policy,
        atlas=atlas,
        sinks=sinks,
        evaluation=evaluation,
        run=run,
    )


def make_source(config: Mapping[str, Any], builder: ComponentBuilder) -> Source:
    """Return the source with its effects; a live one is closed if they cannot be built."""
    source = builder.make("source", Source)
    if config.get("effects"):
        with ExitStack() as opened:
            opened.callback(_release, source)
            changed = builder.make("effects", Source, source)
            opened.pop_all()
        source = changed
    feed = _feed(source)
    return Ordered(source) if feed is None else RisingLive(source, feed)


@contextmanager
def opened_source(config: Mapping[str, Any], builder: ComponentBuilder) -> Iterator[Source]:
    """Give the source with its effects; a live one is closed at the end."""
    source = make_source(config, builder)
    try:
        yield source
    finally:
        _release(source)


def make_evaluation(builder: ComponentBuilder, detector: Detector) -> EvaluationSettings:
    """Return the evaluation; raises ConfigError if it names scenes that the detector has not."""
    evaluation = builder.make("evaluation", EvaluationSettings)
    for scene, name in evaluation.scenes.items():
        if scene not in detector.scenes:
            known = f"a scene of the detector: {', '.join(detector.scenes)}"
            raise ConfigError(f"evaluation.scenes.{scene}", name, known)
    return evaluation


def check_detector(config: Mapping[str, Any], detector: Detector, rig: Rig) -> None:
    """Raise ConfigError if the source lacks sensors that the detector needs."""
    _check_sensors("detector", config["detector"], detector.requires, rig)


def check_mode(run: RunSettings, source: Source) -> None:
    """Raise ConfigError if a live source is run in another mode than `live`."""
    if run.mode != LIVE and _feed(source) is not None:
        raise ConfigError("run.mode", run.mode, f"{LIVE}, since this source measures now: run=live")


def check_no_map(config: Mapping[str, Any]) -> None:
    """Raise ConfigError if a run without SLAM, which makes no map, is to load or save one."""
    atlas = _group(config, "atlas")
    for name in ("load", "save"):
        if atlas.get(name) is not None:
            allowed = f"null where run.mode is {DETECT_ONLY}: no map is loaded or saved"
            raise ConfigError(f"atlas.{name}", atlas[name], allowed)


def _feed(source: Source) -> LiveFeed | None:
    """Return the feed of a live source, None if it is recorded."""
    return source.live if isinstance(source, Live) else None


def _release(source: Source) -> None:
    """Close a source if it is live."""
    feed = _feed(source)
    if feed is not None:
        feed.close()


def _module(builder: ComponentBuilder, run: RunSettings, key: str) -> SlamModule:
    """Return a module, or the process that is building it."""
    make = partial(builder.make, f"slam.{key}", SlamModule)
    if run.isolation == "inline":
        return make()
    return IsolatedModule(f"slam.{key}", make, run.limits)


def _requires(module: SlamModule, key: str) -> Sequence[frozenset[Sensor]]:
    """Return the module's required sensors; raises ConfigError if it could not be built."""
    try:
        return module.requires
    except ConfigError:
        raise
    except ModuleError as error:
        raise ConfigError(key, "process", f"a target that builds (its process {error})") from error
    except Exception as error:
        raise ConfigError(f"{key}.requires", text_of(error), "sets of sensors") from error


def _table(config: Mapping[str, Any], detector: Detector) -> dict[str, tuple[str, ...]]:
    """Return the checked scene table: scene -> keys of modules."""
    modules = [key for key, node in _group(config, "slam").items() if node is not None]
    if not modules:
        raise ConfigError("slam", NOTHING, "SLAM modules; choose a scenario: +scenario=single")
    known = f"a list of keys of slam: {', '.join(modules)}"
    table = _group(config, "scenes")
    for scene in detector.scenes:
        if scene not in table:
            raise ConfigError(f"scenes.{scene}", NOTHING, known)
    for scene, keys in table.items():
        is_list = isinstance(keys, list) and len(keys) > 0
        if not is_list or not all(key in modules for key in keys) or len(set(keys)) < len(keys):
            raise ConfigError(f"scenes.{scene}", keys, f"{known}, each once")
    scenes = {scene: tuple(table[scene]) for scene in detector.scenes}
    for key in modules:
        if key not in _used(scenes):
            if "_target_" not in config["slam"][key]:
                raise ConfigError(f"slam.{key}", config["slam"][key], known)
            _log.warning("slam.%s: no scene names it, so it does not run", key)
    _tell_of_rows(table, scenes)
    return scenes


def _tell_of_rows(table: Mapping[str, Any], scenes: Mapping[str, Sequence[str]]) -> None:
    """Log rows of the scene table without a fallback, and rows of unknown scenes."""
    for scene in table:
        if scene not in scenes:
            _log.warning("scenes.%s: the detector does not report this scene", scene)
        elif len(scenes[scene]) == 1 and len(_used(scenes)) > 1:
            (key,) = scenes[scene]
            what = "without it, poses are bridged until another scene"
            _log.warning("scenes.%s: %s has no fallback; %s", scene, key, what)


def _group(config: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return a table of the top level, empty if it is missing."""
    value = config.get(key)
    if value is not None and not isinstance(value, Mapping):
        raise ConfigError(key, value, "a table of keys")
    return value or {}


def _used(scenes: Mapping[str, Sequence[str]]) -> list[str]:
    """Return all module keys of the table, each once."""
    return list(dict.fromkeys(key for keys in scenes.values() for key in keys))


def _check_sensors(
    key: str, node: Mapping[str, Any], requires: Sequence[frozenset[Sensor]], rig: Rig
) -> None:
    """Raise ConfigError if the source lacks sensors that a component needs."""
    if any(sensors <= rig.sensors for sensors in requires):
        return
    needs = " or ".join(_names(sensors) for sensors in requires)
    name = str(node["_target_"]).rpartition(".")[2]
    raise ConfigError(key, name, f"a source with {needs}; this one has: {_names(rig.sensors)}")


def _names(sensors: frozenset[Sensor]) -> str:
    return " + ".join(sorted(sensor.value for sensor in sensors))
