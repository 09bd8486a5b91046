"""Temporary failure of one sensor of any source."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np

from sceneslam.interfaces import Source
from sceneslam.sources.changes.failures import FAILURES, scene_of, sensor_of
from sceneslam.sources.changes.wrapped import Wrapped, check_sensor
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.ranges import check_among, check_least
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth, SceneChange


class FailingSensor(Wrapped):
    """Passes on a source's observations; during given time spans, one sensor fails.

    `failure` is a name of FAILURES, `spans_s` a list of [from, to] in seconds after the first
    observation; its severity (blur, share of pixels) is drawn from the seed. With `names_scene` the
    true scene during a failure is named after it (camera_frozen: CameraFrozen); else it is the
    source's, or `otherwise` if the source has no true scenes.
    """

    def __init__(
        self,
        source: Source,
        failure: str,
        spans_s: list[list[float]],
        names_scene: bool,
        otherwise: str,
        seed: int,
    ) -> None:
        check_among(FAILURES, failure=failure)
        check_least(0, seed=seed)
        ends = [-1.0]
        for span_s in spans_s:
            if len(span_s) != 2 or not max(0.0, ends[-1]) <= span_s[0] < span_s[1] < np.inf:
                allowed = "[from, to], seconds from 0 on, rising, one span after the other"
                raise ConfigError("spans_s", span_s, allowed)
            ends.append(span_s[1])
        check_sensor(source, sensor_of(failure), failure=failure)
        super().__init__(source)
        self._failure, self._seed = failure, seed
        self._spans_s = spans_s
        self._names_scene, self._otherwise = names_scene, otherwise

    def __iter__(self) -> Iterator[Observation]:
        """Yield the source's observations; within the spans, one sensor fails."""
        failure = FAILURES[self._failure](np.random.default_rng([self._seed, 3]))
        start_ns: int | None = None
        for observation in self._source:
            start_ns = observation.stamp_ns if start_ns is None else start_ns
            time_s = (observation.stamp_ns - start_ns) * 1e-9
            is_failing = any(since_s <= time_s < until_s for since_s, until_s in self._spans_s)
            yield failure.pass_on(observation, is_failing=is_failing)

    def ground_truth(self) -> GroundTruth | None:
        """Return the source's ground truth, with the failures' scenes if `names_scene`."""
        truth = self._source.ground_truth()
        start_ns = self.start_ns() if self._names_scene else None
        if start_ns is None:
            return truth
        return GroundTruth(
            trajectory=truth.trajectory if truth is not None else Trajectory.empty(),
            scenes=self._merged(truth.scenes if truth is not None else (), start_ns),
        )

    def _merged(self, scenes: Sequence[SceneChange], start_ns: int) -> tuple[SceneChange, ...]:
        spans_ns = [[start_ns + round(at_s * 1e9) for at_s in span_s] for span_s in self._spans_s]
        known = [SceneChange(stamp_ns=start_ns, scene=self._otherwise), *scenes]
        turns_ns = sorted(
            {change.stamp_ns for change in known} | {at for s in spans_ns for at in s}
        )
        named = [
            (
                at_ns,
                scene_of(self._failure)
                if any(since <= at_ns < until for since, until in spans_ns)
                else [change.scene for change in known if change.stamp_ns <= at_ns][-1],
            )
            for at_ns in turns_ns
        ]
        firsts = [next(group) for _, group in groupby(named, key=lambda pair: pair[1])]
        return tuple(SceneChange(stamp_ns=at_ns, scene=scene) for at_ns, scene in firsts)
