"""Print what the do-no-harm gate makes of recorded systems, without the bus around it.

    python experiments/openloris_gate.py FOLDER > table.md

FOLDER is laid out as for `+experiment=openloris`. Poses are as reported online: nothing is
revised. `+ 1 deg/m`: the same wheels, turning by so much too much on the way. Below each scene:
Correct Rate [%] / ATE [m] / share of the time the module was trusted [%].
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from numpy.typing import NDArray

from sceneslam.bus.judging.gate import Gate, GateSettings, Judgement
from sceneslam.config.resolve import resolved
from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.evaluation.correctness import CorrectLimits, correct_rate
from sceneslam.experiments.openloris.dataset import Dataset, Sequence
from sceneslam.modules.slam.recorded import Recorded
from sceneslam.types import se3
from sceneslam.types.observation import Observation, TrackingStatus
from sceneslam.types.rig import Rig, Sensor, Wheels
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

RULES = ("never trusted", "always trusted", "both as one", "gate")
FACTORS = (0.5, 1.0, 2.0)  # of the bounds
DRIFTS = (0.0, 1.0)  # [deg/m] added to the odometry
TRUSTED, REFUSED = Judgement(is_trusted=True), Judgement(is_trusted=False)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Driven:
    """A trajectory, and for how much of it the module was trusted."""

    trajectory: Trajectory
    trusted_ratio: float


def main(folder: Path) -> None:
    """Print one line per odometry, system, rule and factor."""
    data, config = Dataset(folder), _config()
    columns = ["odometry", "system", "rule", "bounds", *_scenes(data)]
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    for drift in DRIFTS:
        wheels = {key: _drifting(data.odometry[key].trajectory, drift) for key in data.sequences}
        for system in data.systems:
            poses = {key: _poses(data, system, key, config) for key in data.sequences}
            for rule, factor in _variants():
                settings = _scaled(config.gate, factor)
                driven = {
                    key: _drive(wheels[key], poses[key], rule, settings) for key in data.sequences
                }
                cells = _cells(data, driven, config.limits_m)
                row = [f"+ {drift:g} deg/m", system[:13], rule, f"x {factor:g}", *cells]
                print(f"| {' | '.join(row)} |", flush=True)


def _variants() -> Iterator[tuple[str, float]]:
    for rule in RULES:
        for factor in FACTORS if rule in RULES[2:] else (1.0,):
            yield rule, factor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Config:
    gate: GateSettings
    limits_m: dict[str, float]
    module: dict[str, object]


def _config() -> _Config:
    """Return what the experiment and the policy are configured with."""
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        config = resolved(compose("config", overrides=["+experiment=openloris"]))
    module = dict(config["slam"]["recorded"])
    del module["_target_"]
    gate = instantiate(config["policy"]["gate"])
    return _Config(gate=gate, limits_m=config["openloris"]["limits_m"], module=module)


def _scaled(settings: GateSettings, factor: float) -> GateSettings:
    return GateSettings(sigmas=factor * settings.sigmas)


def _drifting(odometry: Trajectory, drift_deg_per_m: float) -> Trajectory:
    poses = [odometry.T_world_base[0]]
    for T_prev, T_curr in zip(odometry.T_world_base, odometry.T_world_base[1:], strict=False):
        T_prev_curr = se3.inverse(T_prev) @ T_curr
        turn_rad = np.radians(drift_deg_per_m) * np.linalg.norm(T_prev_curr[:3, 3])
        poses.append(poses[-1] @ T_prev_curr @ se3.from_xy_yaw(0.0, 0.0, float(turn_rad)))
    return Trajectory(stamps_ns=odometry.stamps_ns, T_world_base=np.stack(poses))


def _poses(data: Dataset, system: str, key: Sequence, config: _Config) -> list[Transform | None]:
    """Return the module's T_local_base at every stamp of the odometry, None where it is lost."""
    stamps_ns = data.odometry[key].trajectory.stamps_ns.tolist()
    recorded = data.systems[system].get(key)
    if recorded is None:
        return [None] * len(stamps_ns)
    given = {"path": str(recorded.path), "sequence": key.number}
    module = Recorded(**{**config.module, **given, "T_base_frame": recorded.T_base_frame})
    module.activate(Rig(sensors=frozenset({Sensor.ODOMETRY})))
    answers = (module.track(Observation(stamp_ns=stamp_ns)) for stamp_ns in stamps_ns)
    return [
        None if answer.status is TrackingStatus.LOST else answer.T_local_base for answer in answers
    ]


def _drive(
    odometry: Trajectory, poses: list[Transform | None], rule: str, settings: GateSettings
) -> Driven:
    """Chain the module's motion where it is trusted, and bridge where it is not."""
    gate, T_map_base, trusted = Gate(settings, Wheels()), [se3.identity()], 0
    wheels = odometry.T_world_base
    for index in range(len(poses)):
        judgement = gate.update(
            int(odometry.stamps_ns[index]), T_local_base=poses[index], T_odom_base=wheels[index]
        )
        if index == 0:
            continue
        before, now = poses[index - 1], poses[index]
        module = None if before is None or now is None else se3.inverse(before) @ now
        judgement = {"never trusted": REFUSED, "always trusted": TRUSTED}.get(rule, judgement)
        T_prev_curr = se3.inverse(wheels[index - 1]) @ wheels[index]
        if judgement.is_trusted and module is not None:
            T_prev_curr, trusted = module, trusted + 1
        elif rule == "gate" and judgement.turn_agrees and module is not None:
            T_prev_curr = se3.with_yaw(T_prev_curr, se3.yaw_rad(module))
        T_map_base.append(T_map_base[-1] @ T_prev_curr)
    driven = Trajectory(stamps_ns=odometry.stamps_ns, T_world_base=np.stack(T_map_base))
    return Driven(trajectory=driven, trusted_ratio=trusted / len(poses))


def _cells(data: Dataset, driven: dict[Sequence, Driven], limits_m: dict[str, float]) -> list[str]:
    """Return each scene's mean rate, error and trust, weighed by duration."""
    cells = []
    for scene in _scenes(data):
        keys = [key for key in driven if key.scene == scene]
        weights = np.array([np.ptp(data.truth[key].stamps_ns) for key in keys], float)
        rows = [_scores(driven[key], data.truth[key], limits_m[scene]) for key in keys]
        rate, ate_m, trusted = (weights @ np.array(rows)) / weights.sum()
        cells.append(f"{100 * rate:.1f} / {ate_m:.2f} / {100 * trusted:.0f}")
    return cells


def _scenes(data: Dataset) -> list[str]:
    return sorted({key.scene for key in data.sequences})


def _scores(driven: Driven, truth: Trajectory, limit_m: float) -> NDArray[np.float64]:
    rate = correct_rate(
        driven.trajectory, truth, CorrectLimits(limit_m=limit_m, limit_rad=np.pi / 6)
    )
    ate_m = absolute_errors(driven.trajectory, truth, 0.02).rmse_m
    return np.array([rate, ate_m, driven.trusted_ratio])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
