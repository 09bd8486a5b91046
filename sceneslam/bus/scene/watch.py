"""Ask the detector about every observation, and report the confirmed scene."""

from __future__ import annotations

import logging
import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from numbers import Real
from time import perf_counter_ns
from typing import Any

from sceneslam.bus.scene.scene_filter import ConfirmedScene, SceneFilter
from sceneslam.interfaces import Detector
from sceneslam.storage.events import EventLog
from sceneslam.types.errors import ModuleError, calling
from sceneslam.types.observation import UNSURE, Observation, SceneVote
from sceneslam.types.rig import Rig

_log = logging.getLogger(__name__)
_UNLIKELY = 0.01  # probability of the scenes that were not selected, for Bayes filters


def log_vote(
    log: EventLog,
    vote: SceneVote,
    confirmed: ConfirmedScene | None,
    posterior: Mapping[str, float] | None,
) -> None:
    """Log a vote with the scenes' probabilities after it, and the scene that it confirmed."""
    details: dict[str, Any] = {} if posterior is None else {"posterior": posterior}
    if vote.features is not None:
        values = vote.features.items()
        details["features"] = {
            name: value if math.isfinite(value) else None for name, value in values
        }
    log.add("vote", vote.stamp_ns, scene=vote.scene, value=vote.value, **details)
    if confirmed is not None:
        log.add("scene", **asdict(confirmed))


class Watch:
    """Runs the detector; if it fails, the last confirmed scene stays until one is selected."""

    def __init__(
        self, detector: Detector, rig: Rig, log: EventLog, *, scene_filter: SceneFilter
    ) -> None:
        self.spent_us = array("d")
        self.is_working = True
        self.selected = ""  # the scene that an operator selected; "": as the detector votes
        self.confirmed: ConfirmedScene | None = None  # last, None before the first
        self._detector, self._log = detector, log
        self._filter = scene_filter
        with calling("detector could not be activated"):
            detector.activate(rig)

    def look(self, observation: Observation) -> None:
        """Get a vote for the observation; log it and the scene that it confirms."""
        began_ns = perf_counter_ns()
        vote: SceneVote | None = None
        try:
            if self.is_working:
                with calling("detector failed while voting"):
                    found = self._detector.get_scene(observation)
                    vote = self._checked(found, observation.stamp_ns)
        except ModuleError as error:
            self.is_working = False
            self._log.add_fault(observation.stamp_ns, str(error))
        self.spent_us.append((perf_counter_ns() - began_ns) / 1e3)
        if self.selected:
            vote = self._selected(observation.stamp_ns, vote)
        if vote is None:
            return
        confirmed = self._filter.update(vote)
        self.confirmed = confirmed or self.confirmed
        log_vote(self._log, vote, confirmed, self._filter.posterior)

    def close(self) -> None:
        """Shut the detector down. May be called twice."""
        try:
            with calling("the detector could not be shut down"):
                self._detector.shutdown()
        except ModuleError as error:
            _log.warning(str(error))

    def _selected(self, stamp_ns: int, vote: SceneVote | None) -> SceneVote:
        """Return a vote for the selected scene, with the detector's measured value."""
        return SceneVote(
            stamp_ns=stamp_ns,
            scene=self.selected,
            value=math.nan if vote is None else vote.value,
            likelihoods=dict.fromkeys(self._detector.scenes, _UNLIKELY) | {self.selected: 1.0},
        )

    def _checked(self, vote: object, stamp_ns: int) -> SceneVote:
        """Return a vote at a stamp for a known scene; raises TypeError or ValueError."""
        if not isinstance(vote, SceneVote):
            raise TypeError(f"get_scene returned {type(vote).__name__}, expected SceneVote")
        if vote.scene not in (*self._detector.scenes, UNSURE):
            scenes = ", ".join(self._detector.scenes)
            raise ValueError(f"scene: got {vote.scene!r}, expected {scenes} or {UNSURE}")
        if vote.stamp_ns != stamp_ns:
            raise ValueError(f"stamp_ns: got {vote.stamp_ns!r}, expected {stamp_ns}")
        _check_likelihoods(vote.likelihoods, self._detector.scenes)
        features = vote.features
        if features is not None:
            features = {name: _float(number) for name, number in features.items()}
        return replace(vote, stamp_ns=stamp_ns, value=_float(vote.value), features=features)


def _float(number: object) -> float:
    """Return a number of any type, NumPy's included, as a float; raises TypeError."""
    if not isinstance(number, Real):
        raise TypeError(f"value, features: got {type(number).__name__}, expected float")
    return float(number)


def _check_likelihoods(likelihoods: Mapping[str, float] | None, scenes: Sequence[str]) -> None:
    """Raise ValueError unless likelihoods are of known scenes, at least 0, and not all 0."""
    if likelihoods is None:
        return
    values = list(likelihoods.values())
    is_good = all(0 <= value < math.inf for value in values) and sum(values) > 0
    if not is_good or not set(likelihoods) <= set(scenes):
        raise ValueError(f"likelihoods: got {dict(likelihoods)}, expected 0 or more for each scene")
