"""What is known to be true of a recording, for evaluation only."""

from __future__ import annotations

from dataclasses import dataclass, field

from sceneslam.types.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneChange:
    """From `stamp_ns` on, the scene is `scene`."""

    stamp_ns: int
    scene: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundTruth:
    """The true poses and scenes; either may be empty. Frame `gt` need not be `map`."""

    trajectory: Trajectory = field(default_factory=Trajectory.empty)  # T_gt_base
    scenes: tuple[SceneChange, ...] = ()  # by rising stamp; the first names the initial scene
