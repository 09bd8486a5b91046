"""The worker's part of local mapping: relative-pose constraints and bundle adjustment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from sceneslam.types import se3
from sceneslam.types.rig import Camera

from ..see.alignment import Alignment
from ..see.alignment_search import AlignmentSearch, Shown, pair_of
from .bundle import Adjusted, Bundle, adjust
from .pose_constraints import DepthConstraints, PoseConstraint, PoseConstraints


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Task:
    """A part of the map to adjust."""

    bundle: Bundle
    keyframe_ids: list[int]  # (K,) of the bundle's keyframes, ascending
    free_ids: list[int]
    map_ids: frozenset[int]  # of all keyframes in the map; a removed one does not come back
    fresh: Mapping[int, Shown]  # views of new keyframes, by id
    by_odometry: Sequence[tuple[tuple[int, int], PoseConstraint]]  # by keyframe ids


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MappingResult:
    """The adjusted part, and the cameras' alignment if it differs from the assumed one."""

    adjusted: Adjusted
    alignment: Alignment | None
    is_aligned: bool  # False while the alignment is still being estimated


class MappingWork:
    """Does the tasks of one map in order; keeps constraints and the alignment's estimate."""

    def __init__(self, camera: Camera, depth_camera: Camera, alignment: Alignment | None) -> None:
        self._camera = camera
        self._depth_constraints = DepthConstraints(
            depth_camera, (alignment or Alignment()).T_depth_color
        )
        self._search = AlignmentSearch(depth_camera, is_over=alignment is not None)
        self._searched: dict[int, Shown] = {}
        self._found: Alignment | None = None
        self._constraints: dict[tuple[int, int], PoseConstraint] = {}  # by keyframe ids

    def __call__(self, task: Task) -> MappingResult:
        """Return the task's bundle adjusted with its relative-pose constraints."""
        self._tie(task)
        rows = {keyframe_id: row for row, keyframe_id in enumerate(task.keyframe_ids)}
        constraints = [
            ((rows[one], rows[other]), constraint)
            for (one, other), constraint in [*task.by_odometry, *self._constraints.items()]
            if one in rows and other in rows
        ]
        bundle = replace(task.bundle, constraints=PoseConstraints.of(constraints))
        return MappingResult(
            adjusted=adjust(self._camera, bundle),
            alignment=self._found,
            is_aligned=self._search.is_over,
        )

    def _tie(self, task: Task) -> None:
        """Register the new keyframes with the free ones before them; forget removed ones."""
        self._constraints = {
            pair: constraint
            for pair, constraint in self._constraints.items()
            if task.map_ids.issuperset(pair)
        }
        for keyframe_id, shown in task.fresh.items():
            self._depth_constraints.look(keyframe_id, shown.depth_m)
            if not self._search.is_over:
                self._searched[keyframe_id] = shown
        for gone in self._searched.keys() - self._depth_constraints.known_ids:
            del self._searched[gone]
        poses = dict(zip(task.keyframe_ids, task.bundle.T_local_cam, strict=True))
        for other in sorted(task.fresh.keys() & poses.keys()):
            for one in task.free_ids:
                if one < other:
                    T_one_other = se3.inverse(poses[one]) @ poses[other]
                    constraint = self._depth_constraints.between(one, other, T_one_other)
                    if constraint is not None:
                        self._constraints[one, other] = constraint
                        self._compare(one, other, constraint)

    def _compare(self, one: int, other: int, constraint: PoseConstraint) -> None:
        """Compare the colours of two keyframes with the depth camera's motion."""
        if one in self._searched and other in self._searched:
            here, there = self._searched[one], self._searched[other]
            found = self._search.add(pair_of(here, there, se3.inverse(constraint.T_one_other)))
            self._found = found or self._found
        if self._search.is_over:
            self._searched.clear()
