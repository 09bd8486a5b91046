"""OpenLORIS-Scene without its images: recorded wheel odometry, and the ground truth."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from sceneslam.ros.pixels import locked
from sceneslam.sources.spanned import TimeSpan
from sceneslam.sources.survey.survey import Stream, Survey
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.input_files import files_by_number, given_folder
from sceneslam.types.observation import Observation
from sceneslam.types.recorded import RecordedTrajectory, read_recorded
from sceneslam.types.rig import Rig, Sensor, Wheels
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

_ODOMETRY = "recorded/odom"
_TRUTH = "gt"


class OpenLoris:
    """Gives one observation per pose of the wheel odometry, at its own stamp.

    `sequence` is named as in the data set: scene, package and number, as in `home-1-3`. Files are
    distinguished by their headers, not by their names. Shi et al., ICRA 2020.
    """

    def __init__(self, path: str, sequence: str, wheels: Mapping[str, float] | None) -> None:
        named = re.fullmatch(r"([a-z]+)-(\d+)-(\d+)", sequence)
        if named is None:
            raise ConfigError("sequence", sequence, "scene-package-number, as in home-1-3")
        self._wheels = Wheels.given(wheels)
        self._folder = given_folder(path)
        self._scene, self._number = named[1], int(named[3])
        self._odometry = self._find(_ODOMETRY)
        if not len(self._odometry):
            raise InputError(f"no wheel odometry of {sequence}, expected {_ODOMETRY}/*.txt: {path}")

    @property
    def rig(self) -> Rig:
        """Return the rig: wheel odometry only."""
        return Rig(sensors=frozenset({Sensor.ODOMETRY}), wheels=self._wheels)

    @property
    def length(self) -> int | None:
        """Return the number of odometry poses."""
        return len(self._odometry)

    @property
    def faults(self) -> Sequence[str]:
        """Return no faults: invalid poses are left out."""
        return ()

    @property
    def span(self) -> TimeSpan | None:
        """Return the first and last stamp."""
        first_ns, last_ns = self._odometry.stamps_ns[[0, -1]].tolist()
        return TimeSpan(start_ns=first_ns, end_ns=last_ns)

    def __iter__(self) -> Iterator[Observation]:
        """Yield one observation per pose of the odometry."""
        poses = zip(
            self._odometry.stamps_ns.tolist(), self._odometry.T_world_base.copy(), strict=True
        )
        for stamp_ns, T_odom_base in poses:
            yield Observation(stamp_ns=stamp_ns, T_odom_base=locked(T_odom_base))

    def survey(self) -> Survey:
        """Return the stamps and poses of the odometry."""
        wheels = Stream(
            sensor=Sensor.ODOMETRY,
            place=f"{self._scene} {_ODOMETRY}/*.txt",
            count=len(self._odometry),
            stamps_ns=self._odometry.stamps_ns,
        )
        return Survey(
            streams=[wheels],
            odometry_ns=self._odometry.stamps_ns,
            T_odom_base=list(self._odometry.T_world_base),
        )

    def ground_truth(self) -> GroundTruth | None:
        """Return the sequence's true poses of `base`, None if the folder has none."""
        truth = self._find(_TRUTH)
        return GroundTruth(trajectory=truth) if len(truth) else None

    def _find(self, name: str) -> Trajectory:
        """Return the sequence's poses in all text files of a folder; may be empty."""
        for path in files_by_number(self._folder / name, {".txt"}):
            for one in read_recorded(path):
                if (one.scene, one.sequence) == (self._scene, self._number):
                    return _checked(one, path).trajectory
        return Trajectory.empty()


def _checked(one: RecordedTrajectory, path: Path) -> RecordedTrajectory:
    if one.frame not in ("", "base", "base_link"):
        raise InputError(f"expected poses of base_link, got those of {one.frame!r}: {path}")
    return one
