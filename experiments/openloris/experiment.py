"""The experiment `openloris`: recorded systems beside wheel odometry, under one policy.

`conf/experiment/openloris.yaml` says how it is called, `experiments/openloris.md` what was found.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.evaluation.correctness import CorrectLimits, correct_rate
from sceneslam.experiments.openloris.dataset import Dataset, Sequence
from sceneslam.experiments.openloris.figure import draw_rates
from sceneslam.experiments.openloris.rates import Rates, mean, table
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import Figure, Relation, RunTrials, Trial, TrialResult, Verdict
from sceneslam.types.ranges import check_above, check_between, check_least
from sceneslam.types.trajectory import Trajectory

_ALL = "all scenes"
_MATCH_S = 0.02  # truth is published at 10 Hz and more, odometry at 20 Hz


class OpenLorisExperiment:
    """Compares Correct Rates: of a system alone, of odometry alone, and of both together."""

    def __init__(
        self,
        *,
        path: str,
        limits_m: Mapping[str, float],
        limit_rad: float,
        harm_points: float,
        promised: Mapping[str, float],
    ) -> None:
        check_above(0, limits_m=limits_m, limit_rad=limit_rad)
        check_least(0, harm_points=harm_points)
        check_between(0, 100, promised=promised)
        self._path, self._data = path, Dataset(Path(path))
        for sequence in self._data.sequences:
            if sequence.scene not in limits_m:
                known = f"a table with a limit for every scene; {sequence.scene} has none"
                raise ConfigError("limits_m", dict(limits_m), known)
        self._limits_m, self._limit_rad = limits_m, limit_rad
        self._harm_points, self._promised = harm_points, promised

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Run every system on every sequence; return the rates and what holds of them."""
        pairs = [(system, key) for system in self._data.systems for key in self._data.sequences]
        outcomes = run_trials([self._trial(*pair) for pair in pairs])
        rates = [self._rates(*pair, outcome) for pair, outcome in zip(pairs, outcomes, strict=True)]
        means = [one for system in self._data.systems for one in _means(system, rates)]
        draw_rates(folder / "rates.png", means)
        return Verdict(
            figures=self._figures([*rates, *means]),
            table=table([*rates, *means]),
            pictures={"rates.png": "Correct Rates per system and scene."},
        )

    def _trial(self, system: str, key: Sequence) -> Trial:
        """Return the run of a system beside odometry; of odometry where nothing was recorded."""
        name = f"{system}/{key.name}"
        values = {"source": {"path": self._path, "sequence": key.name}}
        recorded = self._data.systems[system].get(key)
        if recorded is None:
            overrides = ("slam@slam.recorded=odometry",)
            return Trial(name=name, overrides=overrides, values=values)
        module = {
            "path": str(recorded.path),
            "sequence": key.number,
            "T_base_frame": recorded.T_base_frame,
        }
        return Trial(name=name, values={**values, "slam": {"recorded": module}})

    def _rates(self, system: str, key: Sequence, outcome: TrialResult) -> Rates:
        recorded = self._data.systems[system].get(key)
        stamps_ns = self._data.truth[key].stamps_ns
        return Rates(
            system=system,
            scene=key.scene,
            name=key.name,
            duration_s=float(stamps_ns[-1] - stamps_ns[0]) * 1e-9,
            alone=self._rate(key, recorded.trajectory if recorded else Trajectory.empty()),
            odometry=self._rate(key, self._data.odometry[key].trajectory),
            together=self._rate(key, outcome.trajectory),
            told=self._rate(key, outcome.online),
            ate_odometry_m=self._ate_m(key, self._data.odometry[key].trajectory),
            ate_together_m=self._ate_m(key, outcome.trajectory),
        )

    def _rate(self, key: Sequence, trajectory: Trajectory) -> float:
        """Return the Correct Rate [%] by the data set's rule."""
        truth, limit_m = self._data.truth[key], self._limits_m[key.scene]
        rate = correct_rate(
            trajectory, truth, CorrectLimits(limit_m=limit_m, limit_rad=self._limit_rad)
        )
        return 100.0 * rate

    def _ate_m(self, key: Sequence, trajectory: Trajectory) -> float:
        return absolute_errors(trajectory, self._data.truth[key], _MATCH_S).rmse_m

    def _figures(self, rates: list[Rates]) -> list[Figure]:
        """Return what was promised: no harm on any sequence, and the rates of some systems."""
        harm = [
            Figure(
                name=f"{one.system}, {one.name}: together above the better of the two",
                value=one.margin,
                relation=Relation.AT_LEAST,
                bound=-self._harm_points,
                unit="points",
            )
            for one in rates
        ]
        promised = [
            Figure(
                name=f"{one.system}, {_ALL}: Correct Rate together with odometry",
                value=one.together,
                relation=Relation.AT_LEAST,
                bound=self._promised[one.system],
                unit="%",
            )
            for one in rates
            if one.name == _ALL and one.system in self._promised
        ]
        return [*harm, *promised]


def _means(system: str, rates: list[Rates]) -> list[Rates]:
    """Return a system's mean per scene, and over all."""
    own = [one for one in rates if one.system == system]
    scenes = sorted({one.scene for one in own})
    per_scene = [mean([one for one in own if one.scene == scene], scene) for scene in scenes]
    return [*per_scene, mean(own, _ALL)]
