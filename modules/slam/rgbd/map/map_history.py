"""The module's history: places, the pose graph, and the poses of all frames."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sceneslam.graphs.edge import Edge
from sceneslam.types import se3
from sceneslam.types.maps import LandmarkLayer, PoseGraphLayer
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

from ...frame_log import FrameLog, joined
from ...model_error import motion_covariance
from ..locate.localizer import VisualFix, VisualLocalizer
from ..locate.recognition import PlaceRecognizer
from ..loops.loop_closing import VisualLoopCloser
from ..loops.loop_detection import LoopDetector, Query
from ..loops.pose_graph import PoseGraph
from ..see.rectifying_extractor import RectifyingExtractor
from ..settings import RgbdSettings
from .keyframes import Keyframe, motion_between
from .segments import Segments
from .visual_map import VisualMap

_MIN_SHARE = 0.1  # least share of a pose's landmarks from a keyframe, for an edge to it
_GUESSED_VARIANCE = 0.05**2  # [m^2] and [rad^2], of a keyframe placed by an earlier map
_NEVER_SAW = -1


class MapHistory:
    """Records the map's growth and pruning, and corrects the map when a place is recognized."""

    def __init__(
        self,
        visual_map: VisualMap,
        localizer: VisualLocalizer,
        eye: RectifyingExtractor,
        *,
        settings: RgbdSettings,
    ) -> None:
        self._map, self._eye = visual_map, eye
        self._graph, self._frames = PoseGraph(), FrameLog()
        self._keyframes: dict[int, Keyframe] = {}  # as the map has them
        self.recognizer = PlaceRecognizer(
            visual_map, localizer, min_inliers=settings.degraded_inliers
        )
        detector = LoopDetector(visual_map, self.recognizer, self._graph)
        self._closer = VisualLoopCloser(
            visual_map, detector, self._graph, is_repeatable=settings.is_repeatable
        )
        self.segments = Segments(self._graph, self._keyframes)
        self.reference = _NEVER_SAW  # the keyframe that the newest frame refers to
        self.revision = 0  # increases with every correction
        self._before = Trajectory.empty()  # poses of the map that this one replaced

    def follow(self, before: MapHistory, T_local_keyframe: Mapping[int, Transform]) -> None:
        """Continue from a map that is replaced; `T_local_keyframe` are its corrected keyframes."""
        before._closer.finish()
        before.shutdown()
        poses = {k: keyframe.T_local_base for k, keyframe in before._keyframes.items()}
        frames = before._frames.trajectory(poses | dict(T_local_keyframe))
        self._before, self.revision = joined(before._before, frames), before.revision + 1

    def hold(self, stamp_ns: int, T_local_base: Transform, landmark_ids: NDArray[np.int64]) -> None:
        """Record T_local_base (4, 4) relative to the keyframe with most of the landmarks (N,)."""
        keyframes = self._map.keyframes
        near = [self.reference, keyframes.ids[-1], *self._graph.neighbours(self.reference)]
        shared = keyframes.shared(landmark_ids, near)
        if shared.any():
            self.reference = near[int(np.argmax(shared))]
        else:  # it was relocalized elsewhere
            self.reference = [*keyframes.covisible(landmark_ids, limit=1), *near][0]
        T_local_keyframe = keyframes[self.reference].T_local_base
        T_keyframe_base = se3.inverse(T_local_keyframe) @ T_local_base
        self._frames.add(stamp_ns, self.reference, T_keyframe_base, self._eye.twist_per_s)

    def around(self, T_local_base: Transform) -> list[Transform]:
        """Return T_keyframe_base of a pose for the keyframes near the newest frame."""
        near = [self.reference, *self._graph.neighbours(self.reference)]
        return [se3.inverse(self._map.keyframes[k].T_local_base) @ T_local_base for k in near]

    def insert(
        self,
        fix: VisualFix | None,
        depth_m: NDArray[np.float32] | None,
        *,
        predicted: NDArray[np.float64] | None = None,
        guessed_s: float | None,
    ) -> None:
        """Add the newest keyframe with depth (H, W) [m]; `fix`: its pose, None for odometry.

        `predicted`: covariance (6, 6) of a pose by odometry, None: not known. `guessed_s`: time
        without a pose if its pose is a guess; then it begins a segment.
        """
        keyframe_id = self._map.keyframes.ids[-1]
        keyframe = self._map.keyframes[keyframe_id]
        self._graph.insert(keyframe_id)
        if guessed_s is None:
            for edge in self._edges(keyframe_id, fix, predicted):
                self._graph.connect(edge)
        else:
            self.segments.begin(keyframe_id, lost_s=guessed_s)
        self._keyframes[keyframe_id] = keyframe
        self.recognizer.places.insert(keyframe_id, keyframe.features.descriptors)
        self._closer.insert(Query(keyframe_id=keyframe_id, depth_m=depth_m))
        self.reference = keyframe_id
        self._map.keep_limits()  # only now, as what it removes may connect the new one
        self._follow_removals()

    def segment(self, landmark_ids: NDArray[np.int64]) -> set[int] | None:
        """Return the keyframes of the landmarks' (N,) segment; None: there is only one segment."""
        if not self.segments.are_many:
            return None
        seen = self._map.keyframes.covisible(landmark_ids, limit=1)
        return self._graph.connected(seen[0]) if seen else None

    def step(self) -> Transform | None:
        """Do one image's share of loop closing; return T_new_old of the current pose, if moved."""
        corrections = self._closer.step()
        if self._closer.is_solving:
            return None
        if self.segments.are_many:  # a loop may have joined some, even where it moved nothing
            self.segments.update()
        if corrections:
            self.revision += 1
            return corrections.get(self.reference, se3.identity())
        return self._straighten(self._eye.shutter.step_s())

    def trajectory(self) -> Trajectory:
        """Return T_local_base of all tracked frames, corrected by all loops."""
        self._closer.finish()
        frames = self._frames.trajectory({k: v.T_local_base for k, v in self._keyframes.items()})
        return joined(self._before, frames)

    def pose_graph(self) -> PoseGraphLayer | None:
        """Return the keyframes and the measured motions between them."""
        if not self._keyframes:
            return None
        rows = {keyframe_id: row for row, keyframe_id in enumerate(self._keyframes)}
        keyframes, edges = list(self._keyframes.values()), self._graph.edges
        return PoseGraphLayer(
            stamps_ns=np.array([k.stamp_ns for k in keyframes]),
            T_world_base=np.stack([k.T_local_base for k in keyframes]),
            edges=np.array([(rows[e.first], rows[e.second]) for e in edges], int).reshape(-1, 2),
            T_from_to=np.array([e.T_first_second for e in edges]).reshape(-1, 4, 4),
            information=np.array([np.linalg.inv(e.covariance) for e in edges]).reshape(-1, 6, 6),
            is_loop=np.array([e.is_loop for e in edges], bool),
        )

    def landmarks(self) -> LandmarkLayer | None:
        """Return the landmarks with the stamp of the first remaining keyframe that saw them."""
        owned = self._map.keyframes.owned_landmarks()
        if not owned:
            return None
        table, ids = self._map.landmarks, np.concatenate(list(owned.values()))
        counts = [len(landmark_ids) for landmark_ids in owned.values()]
        stamps_ns = np.array([self._keyframes[keyframe_id].stamp_ns for keyframe_id in owned])
        return LandmarkLayer(
            points=table.points_local[ids].astype(np.float32),
            first_stamps_ns=np.repeat(stamps_ns, counts),
            sightings=table.found[ids],
        )

    def shutdown(self) -> None:
        """End the worker; the history stays readable."""
        self._closer.shutdown()

    def _straighten(self, readout_s: float) -> Transform | None:
        """Correct for a readout longer by `readout_s`; return T_new_old of the current pose."""
        if not readout_s or not len(self._frames):
            return None
        T_local_old = self._newest()
        self._map.straighten(readout_s)
        twists = {k: keyframe.turning.twist_per_s for k, keyframe in self._keyframes.items()}
        self._frames.straighten(readout_s, twists)
        self.revision += 1
        return np.asarray(self._newest() @ se3.inverse(T_local_old))

    def _newest(self) -> Transform:
        """Return T_local_base of the newest frame."""
        keyframe_id, T_keyframe_base = self._frames.newest
        return np.asarray(self._keyframes[keyframe_id].T_local_base @ T_keyframe_base)

    def _edges(
        self, keyframe_id: int, fix: VisualFix | None, predicted: NDArray[np.float64] | None
    ) -> list[Edge]:
        """Return the edges to the keyframes against which a new keyframe's pose was measured.

        A landmark belongs to the keyframe that saw it first; the edge to each such keyframe gets
        its landmarks' share of the information, so that nothing is counted twice. Small shares get
        none, but the largest one gets an edge however small it is.
        """
        earlier = self._keyframes
        if not earlier:
            return []
        T_local_base = self._map.keyframes[keyframe_id].T_local_base
        if fix is None:
            last = max(earlier)
            T_last_new = se3.inverse(earlier[last].T_local_base) @ T_local_base
            motion = motion_between(earlier[last], self._map.keyframes[keyframe_id])
            covariance = _GUESSED_VARIANCE * np.eye(6) if predicted is None else predicted
            covariance = covariance if motion is None else motion.covariance
            return [
                Edge(
                    first=last, second=keyframe_id, T_first_second=T_last_new, covariance=covariance
                )
            ]
        counts = self._origins(fix.landmark_ids)
        total = sum(counts.values())
        most = max((count for k, count in counts.items() if k in earlier), default=0)
        return [
            _edge(
                k,
                keyframe_id,
                se3.inverse(earlier[k].T_local_base) @ T_local_base,
                fix.estimate.covariance * (total / count),
            )
            for k, count in counts.items()
            if k in earlier and (count > _MIN_SHARE * total or count == most)
        ]

    def _origins(self, landmark_ids: NDArray[np.int64]) -> dict[int, int]:
        """Return how many of these landmarks each keyframe saw first."""
        owned = self._map.keyframes.owned_landmarks()
        owners = np.repeat(list(owned), [len(ids) for ids in owned.values()])
        wanted = np.isin(np.concatenate(list(owned.values())), landmark_ids)
        keyframe_ids, counts = np.unique(owners[wanted], return_counts=True)
        return dict(zip(keyframe_ids.tolist(), counts.tolist(), strict=True))

    def _follow_removals(self) -> None:
        """Refer frames and edges of removed keyframes to other keyframes."""
        for keyframe_id in sorted(set(self._keyframes) - set(self._map.keyframes.ids)):
            edge = self._graph.remove(keyframe_id)
            # What nothing is connected to stays where it was guessed to be.
            heir_id = self._map.keyframes.ids[0] if edge is None else edge.first
            gone, heir = self._keyframes[keyframe_id], self._keyframes[heir_id]
            T_heir_gone = se3.inverse(heir.T_local_base) @ gone.T_local_base
            self._frames.hand_over(keyframe_id, heir_id, T_heir_gone)
            self.segments.replace(keyframe_id, None if edge is None else heir_id, T_heir_gone)
            self.reference = heir_id if self.reference == keyframe_id else self.reference
            del self._keyframes[keyframe_id]
            self.recognizer.places.remove(keyframe_id)


def _edge(
    first: int, second: int, T_first_second: Transform, covariance: NDArray[np.float64]
) -> Edge:
    covariance = motion_covariance(T_first_second, covariance)
    return Edge(first=first, second=second, T_first_second=T_first_second, covariance=covariance)
