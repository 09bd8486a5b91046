"""One SLAM module under the bus's care: called, timed, and stopped when it breaks its promise."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from time import perf_counter_ns

import numpy as np

from sceneslam.interfaces import Restartable, SlamModule
from sceneslam.types.errors import ModuleError
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import Observation, Tracking
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Legacy:
    """What a module leaves behind."""

    layers: MapLayers
    trajectory: Trajectory  # T_local_base as revised, empty where nothing was


class Runner:
    """Turns whatever a module raises into a ModuleError, and refuses poses that are not finite."""

    def __init__(self, key: str, module: SlamModule) -> None:
        self.key = key
        self.is_failed = False
        self.T_map_local: Transform | None = None  # None until it is placed
        self.track_ms: list[float] = []
        self.spent_ns = 0  # in all calls together
        self._is_active = False
        self._module = module
        # What every set holds is what it works on; without such, any of them may be.
        common = frozenset[Sensor].intersection(*module.requires)
        self._sensors = common or frozenset[Sensor]().union(*module.requires)

    @property
    def can_run(self) -> bool:
        """Tell whether the module can be activated at once."""
        module = self._module
        return not self.is_failed or (isinstance(module, Restartable) and module.is_ready)

    @property
    def may_return(self) -> bool:
        """Tell whether the module can be activated, at once or after a wait."""
        module = self._module
        return not self.is_failed or (isinstance(module, Restartable) and not module.is_spent)

    def activate(self, rig: Rig, scene: str) -> None:
        """Start the module anew; raises ModuleError when it cannot."""
        self.T_map_local, self.is_failed = None, False
        began_ns = perf_counter_ns()
        try:
            self._module.activate(rig)
            self._module.set_scene(scene)
            self._is_active = True
        except Exception as error:
            raise self._failed("could not be activated", error) from error
        finally:
            self.spent_ns += perf_counter_ns() - began_ns

    def place(self, T_map_local: Transform) -> None:
        """Place the module's frame in the map."""
        self.T_map_local = T_map_local
        try:
            self._module.set_pose(T_map_local)
        except Exception as error:
            raise self._failed("could not be placed", error) from error

    def set_scene(self, scene: str) -> None:
        """Tell the module of a confirmed scene that it goes on with."""
        try:
            self._module.set_scene(scene)
        except Exception as error:
            raise self._failed("could not take the scene", error) from error

    def can_use(self, observation: Observation) -> bool:
        """Tell whether the observation holds any sensor that the module works on."""
        return any(observation.has(sensor) for sensor in self._sensors)

    def track(self, observation: Observation) -> Tracking:
        """Return the module's answer; raises ModuleError on an exception or no proper pose."""
        began_ns = perf_counter_ns()
        try:
            tracking = _checked(self._module.track(observation))
        except Exception as error:
            raise self._failed("failed while tracking", error) from error
        finally:
            cost_ns = perf_counter_ns() - began_ns
            self.spent_ns += cost_ns
            self.track_ms.append(cost_ns / 1e6)
        return tracking

    def retire(self) -> Legacy:
        """Shut the module down and return what it leaves, empty where it cannot give it."""
        layers, trajectory = MapLayers(), Trajectory.empty()
        began_ns = perf_counter_ns()
        try:
            if self._is_active:
                trajectory = _checked_trajectory(self._module.get_trajectory())
        except Exception as error:
            self._report("could not give its trajectory", error)
        try:
            if self._is_active:
                layers = self._module.get_map()
        except Exception as error:
            self._report("could not give its map", error)
        try:
            self._module.shutdown()
        except Exception as error:
            self._report("could not be shut down", error)
        self._is_active = False
        self.spent_ns += perf_counter_ns() - began_ns
        return Legacy(layers=layers, trajectory=trajectory)

    def _failed(self, what: str, error: Exception) -> ModuleError:
        self.is_failed = True
        if isinstance(self._module, Restartable):
            self._module.note_failure()
        return ModuleError(self._sentence(what, error))

    def _report(self, what: str, error: Exception) -> None:
        _log.warning(self._sentence(what, error))

    def _sentence(self, what: str, error: Exception) -> str:
        _log.info("slam.%s %s", self.key, what, exc_info=error)
        return f"slam.{self.key} {what}: {type(error).__name__}: {error}"


def _checked(tracking: object) -> Tracking:
    """Return an answer whose pose is the bus's to keep; raises TypeError or ValueError."""
    if not isinstance(tracking, Tracking):
        raise TypeError(f"track returned {type(tracking).__name__}, expected Tracking")
    T_local_base = np.array(tracking.T_local_base, dtype=np.float64)
    if T_local_base.shape != (4, 4):
        raise ValueError(f"T_local_base: expected (4, 4), got {T_local_base.shape}")
    if not math.isfinite(T_local_base.sum()):
        raise ValueError("T_local_base: it is not finite")
    T_local_base.flags.writeable = False
    return replace(tracking, T_local_base=T_local_base)


def _checked_trajectory(trajectory: object) -> Trajectory:
    """Return a trajectory of finite poses by rising stamp; raises TypeError or ValueError."""
    if not isinstance(trajectory, Trajectory):
        raise TypeError(f"get_trajectory returned {type(trajectory).__name__}, expected Trajectory")
    if trajectory.T_world_base.shape != (len(trajectory), 4, 4):
        raise ValueError(f"T_world_base: expected (N, 4, 4), got {trajectory.T_world_base.shape}")
    if not np.isfinite(trajectory.T_world_base).all():
        raise ValueError("T_world_base: it is not finite")
    if (np.diff(trajectory.stamps_ns) <= 0).any():
        raise ValueError("stamps_ns: they do not rise")
    return trajectory
