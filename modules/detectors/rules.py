"""Scenes by configurable rules over features; new scenes need no code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import UNSURE, Observation, SceneVote
from sceneslam.types.rig import Rig, Sensor

from .features import FEATURES, FEATURES_OVER_TIME, Measure

Limit = float | str | None  # str: the name of a value
Limits = Mapping[str, Sequence[Limit]]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rule:
    """A scene with limits (low, high) for its features."""

    scene: str
    sensors: frozenset[Sensor]
    indices: NDArray[np.int64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def holds(self, features: NDArray[np.float64], margin_ratio: float) -> bool | None:
        """Tell whether all features are within their limits, None if one is missing."""
        values = features[self.indices]
        if np.isnan(values).any():
            return None
        low_margin, high_margin = (
            margin_ratio * np.nan_to_num(np.abs(limit), posinf=0.0)
            for limit in (self.low, self.high)
        )
        inside = (values >= self.low - low_margin) & (values < self.high + high_margin)
        return bool(inside.all())


class Rules:
    """Votes for the first scene, in the rules' order, whose conditions all hold.

    Each rule has a name, by which another configuration can change it, and is `{scene: NAME, when:
    {FEATURE: [low, high], ...}}` with null for no limit. A rule that is null is ignored, and with
    `skip_absent_sensors` also one that needs a sensor that the source does not have. If no rule
    holds, the vote is `otherwise` (null: UNSURE). The last scene is kept until its limits, wider by
    `hysteresis_ratio`, are exceeded, or an earlier rule holds. A measurement is valid for
    `hold_s`, as sensors measure at different stamps. A limit can be the name of one
    of the `values`, for use in several rules.
    """

    quantity = ""
    feature_settings = ("features", "hold_s")

    def __init__(
        self,
        features: Sequence[str],
        rules: dict[str, dict[str, Any] | None],
        otherwise: str | None,
        hysteresis_ratio: float,
        hold_s: float,
        values: dict[str, float],
        skip_absent_sensors: bool,
    ) -> None:
        _check_features(features)
        if not 0 <= hysteresis_ratio < 1:
            raise ConfigError("hysteresis_ratio", hysteresis_ratio, "0 to below 1")
        if not 0 <= hold_s < np.inf:
            raise ConfigError("hold_s", hold_s, "seconds, 0 or more")
        used = {name: rule for name, rule in rules.items() if rule is not None}
        if not used:
            raise ConfigError("rules", rules, "one rule or more that is not null")
        if otherwise in ("", UNSURE):
            raise ConfigError("otherwise", otherwise, f"a scene, not {UNSURE}, or null")
        self._features = tuple(features)
        self._hold_ns = round(hold_s * 1e9)
        self._skips = skip_absent_sensors
        self._values = dict(values)
        self._rules = [self._read(f"rules.{name}", rule) for name, rule in used.items()]
        self._present = self._rules  # rules whose sensors the rig has ...
        self._told = list(range(len(self._features)))  # ... and the features that votes report
        self._otherwise = otherwise or UNSURE
        self._hysteresis_ratio = hysteresis_ratio
        self._voted: str | None = None
        named = [*(rule.scene for rule in self._rules), *([otherwise] if otherwise else [])]
        self.scenes = tuple(dict.fromkeys(named))

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the sensors of all features; none with `skip_absent_sensors`."""
        if self._skips:
            return (frozenset(),)
        return (frozenset(_sensor(name) for name in self._features),)

    def activate(self, rig: Rig) -> None:
        """Reset the last vote and all measurements."""
        self._voted = None
        self._measures: list[Measure] = [
            FEATURES[name].measure if name in FEATURES else FEATURES_OVER_TIME[name].make(rig)
            for name in self._features
        ]
        self._latest = np.full(len(self._features), np.nan)
        self._measured_ns = np.zeros(len(self._features), np.int64)
        self._present = [
            rule for rule in self._rules if not self._skips or rule.sensors <= rig.sensors
        ]
        self._told = [
            index
            for index, name in enumerate(self._features)
            if not self._skips or _sensor(name) in rig.sensors
        ]

    def get_scene(self, observation: Observation) -> SceneVote:
        """Return the first scene whose conditions hold."""
        return self.decide(observation.stamp_ns, self.get_features(observation))

    def get_features(self, observation: Observation) -> NDArray[np.float64] | None:
        """Return the configured features (F,), NaN if its sensor is missing for `hold_s`."""
        values = np.array([measure(observation) for measure in self._measures])
        is_new = ~np.isnan(values)
        self._latest[is_new] = values[is_new]
        self._measured_ns[is_new] = observation.stamp_ns
        is_old = observation.stamp_ns - self._measured_ns >= self._hold_ns
        values = np.where(is_old & ~is_new, np.nan, self._latest)
        return None if np.isnan(values).all() else values

    def decide(self, stamp_ns: int, features: NDArray[np.float64] | None) -> SceneVote:
        """Return the vote for features (F,); UNSURE if an earlier rule has a missing feature."""
        if features is None:
            return SceneVote(stamp_ns=stamp_ns, scene=UNSURE)
        scene = self._first(features)
        if scene != UNSURE:
            self._voted = scene
        measured = {self._features[index]: float(features[index]) for index in self._told}
        return SceneVote(stamp_ns=stamp_ns, scene=scene, features=measured)

    def shutdown(self) -> None:
        """Do nothing."""

    def _first(self, features: NDArray[np.float64]) -> str:
        for rule in self._present:
            margin_ratio = self._hysteresis_ratio if rule.scene == self._voted else 0.0
            holds = rule.holds(features, margin_ratio)
            if holds is None:
                return UNSURE
            if holds:
                return rule.scene
        return self._otherwise

    def _read(self, key: str, rule: Mapping[str, str | Limits]) -> _Rule:
        scene, when = rule.get("scene"), rule.get("when")
        if set(rule) != {"scene", "when"} or not isinstance(scene, str) or scene in ("", UNSURE):
            raise ConfigError(key, dict(rule), f"a scene, not {UNSURE}, and when")
        if not isinstance(when, Mapping) or not when or not set(when) <= set(self._features):
            raise ConfigError(f"{key}.when", when, f"limits of {', '.join(self._features)}")
        pairs = [self._pair(f"{key}.when.{name}", limits) for name, limits in when.items()]
        return _Rule(
            scene=scene,
            sensors=frozenset(map(_sensor, when)),
            indices=np.array([self._features.index(name) for name in when], np.int64),
            low=np.array([low for low, _ in pairs], np.float64),
            high=np.array([high for _, high in pairs], np.float64),
        )

    def _pair(self, key: str, limits: Sequence[Limit]) -> tuple[float, float]:
        """Return [low, high] as numbers; raises ConfigError."""
        is_pair = isinstance(limits, Sequence) and not isinstance(limits, str) and len(limits) == 2
        pair = limits if is_pair else ()
        known = [self._values.get(x, x) if isinstance(x, str) else x for x in pair]
        numbers = [one for one in known if one is not None]
        is_number = all(isinstance(one, int | float) and np.isfinite(one) for one in numbers)
        if not is_number or sorted(set(numbers)) != numbers or not numbers:
            names = f", or one of values: {', '.join(self._values)}" if self._values else ""
            allowed = f"[low, high], low below high, null for no limit{names}"
            raise ConfigError(key, limits, allowed)
        low, high = known
        return -np.inf if low is None else float(low), np.inf if high is None else float(high)


def _sensor(feature: str) -> Sensor:
    found = FEATURES.get(feature) or FEATURES_OVER_TIME[feature]
    return found.sensor


def _check_features(names: Sequence[str]) -> None:
    known = (*FEATURES, *FEATURES_OVER_TIME)
    if not names or not set(names) <= set(known) or len(set(names)) < len(names):
        raise ConfigError("features", list(names), f"different ones of {', '.join(known)}")
