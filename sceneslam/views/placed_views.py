"""Views at their poses in a map: which of them resemble another view, and which one it shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform
from sceneslam.views.place_index import PlaceIndex
from sceneslam.views.view import Landmarks

_LIKE = 40  # most similar views that candidates are taken from
_PLACES, _PER_PLACE = 4, 2  # that are looked at, and views of each
_PLACE_M = 2.0  # views this near show one place ...
_FACING_RAD = 1.0  # ... if they face the same way: a camera sees as much
_ALIKE = 0.6  # another place with so many of the best one's matches, and nothing is recognized
_SAME_M, _SAME_RAD = 0.3, 0.15
_DEVIATION_MAX_M = 0.03  # of a pose: two that agree are no chance
_DEVIATION_MAX_RAD = 0.03  # 1.7 degrees: a camera held by hand turns while its rows are read
_VIEW_M, _VIEW_RAD = 0.5, 0.4  # from a view that shows the same ...
_ENOUGH = 100  # ... if it has as many landmarks, or so many: a quarter of them is MATCHES_MIN
PRECISE_M = 0.1  # standard deviation of a distance: less precise ones tell little of a motion
SIGMAS = 3.0  # by which two measurements of a landmark differ, at most
MATCHES_MIN = 25  # right by the pose found; by chance hardly more are than the three it is made of
FLOOR = np.diag(np.repeat([0.01, 0.004], 3) ** 2)  # m, rad: of the map's landmarks among each other


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sighting:
    """The pose of a view in the map."""

    T_map_cam: Transform
    covariance: NDArray[np.float64]  # (6, 6) of se3.log order, axes of the camera
    matches: int

    @property
    def is_certain(self) -> bool:
        """Tell whether another sighting that agrees is no chance."""
        return self.is_within(_DEVIATION_MAX_M, _DEVIATION_MAX_RAD)

    def is_within(self, deviation_m: float, deviation_rad: float) -> bool:
        """Tell whether the standard deviations of the pose are at most so large."""
        shift, turn = self.covariance[:3, :3], self.covariance[3:, 3:]
        is_near = np.linalg.eigvalsh(shift)[-1] <= deviation_m**2
        return bool(is_near and np.linalg.eigvalsh(turn)[-1] <= deviation_rad**2)


class PlacedViews:
    """Landmarks of views, with their poses T_map_cam (4, 4)."""

    def __init__(self, placed: Sequence[tuple[Transform, Landmarks]] = ()) -> None:
        self._placed: list[tuple[Transform, Landmarks]] = []
        self._index = PlaceIndex()
        for T_map_cam, landmarks in placed:
            self.add(T_map_cam, landmarks)

    def __len__(self) -> int:
        return len(self._placed)

    def __getitem__(self, number: int) -> tuple[Transform, Landmarks]:
        return self._placed[number]

    def add(self, T_map_cam: Transform, landmarks: Landmarks) -> None:
        """Add a view at T_map_cam (4, 4)."""
        self._index.insert(len(self._placed), landmarks.descriptors)
        self._placed.append((T_map_cam, landmarks))

    def move(self, T_map_cam: Sequence[Transform]) -> None:
        """Set the poses (4, 4) of all views."""
        moved = zip(T_map_cam, self._placed, strict=True)
        self._placed = [(T, landmarks) for T, (_, landmarks) in moved]

    def cut(self, count: int) -> None:
        """Leave the first `count` views."""
        for number in range(count, len(self._placed)):
            self._index.remove(number)
        del self._placed[count:]

    def near(self, T_map_cam: Transform) -> list[int]:
        """Return the views that were taken near a pose (4, 4), facing that way, nearest first."""
        poses = np.reshape([T for T, _ in self._placed], (-1, 4, 4))
        away_m = np.linalg.norm((poses - T_map_cam)[:, :3, 3], axis=1)
        turned_rad = se3.rotation_angle_rad(se3.inverse(T_map_cam) @ poses)
        is_near = (away_m < _PLACE_M) & (turned_rad < _FACING_RAD)
        nearest = np.argsort(away_m, kind="stable")
        return [int(number) for number in nearest[is_near[nearest]]]

    def recognize(
        self,
        descriptors: NDArray[np.uint8],
        seen_at: Callable[[int], Sighting | None],
        among: Sequence[int] | None = None,
    ) -> tuple[int, Sighting] | None:
        """Return the view that shows the same place, with the pose that `seen_at` gives for it.

        None if no view shows it, or if two views show different places about equally well.
        """
        found = [
            (number, one)
            for number in self._alike(descriptors, among)
            if (one := seen_at(number)) is not None
        ]
        if not found:
            return None
        number, best = max(found, key=lambda pair: pair[1].matches)
        for _, other in found:
            off = se3.inverse(best.T_map_cam) @ other.T_map_cam
            is_same = se3.is_within(off, _SAME_M, _SAME_RAD)
            if other.matches >= _ALIKE * best.matches and not is_same:
                return None
        return number, best

    def _alike(self, descriptors: NDArray[np.uint8], among: Sequence[int] | None) -> list[int]:
        """Return the most similar views, a few of each of the most similar places."""
        places: list[list[int]] = []
        for likeness in self._index.alike(descriptors, among)[:_LIKE]:
            number = likeness.place_id
            same = next((one for one in places if self._is_near(one[0], number)), None)
            if same is None and len(places) < _PLACES:
                places.append([number])
            elif same is not None and len(same) < _PER_PLACE:
                same.append(number)
        return [number for place in places for number in place]

    def _is_near(self, one: int, other: int) -> bool:
        """Tell whether two views show one place."""
        at, there = (self._placed[number][0][:3, 3] for number in (one, other))
        return bool(np.linalg.norm(at - there) < _PLACE_M)


def are_covered(
    views: Sequence[tuple[Transform, Landmarks]], others: Sequence[tuple[Transform, Landmarks]]
) -> NDArray[np.bool_]:
    """Tell of each view (N,), with its pose (4, 4), whether one of the others shows as much."""
    poses, other_poses = (
        np.reshape([T for T, _ in placed], (-1, 4, 4)) for placed in (views, others)
    )
    alike = are_alike(poses, other_poses)
    near = np.flatnonzero(alike.any(axis=0))  # of the others; no landmarks of the rest are counted
    counts, other_counts = (
        np.array([_counts(landmarks) for _, landmarks in placed], np.int64).reshape(-1, 1, 2)
        for placed in (views, [others[number] for number in near.tolist()])
    )
    is_as_much = (other_counts[:, 0] >= np.minimum(counts, _ENOUGH)).all(axis=2)
    return np.asarray((alike[:, near] & is_as_much).any(axis=1))


def _counts(landmarks: Landmarks) -> tuple[int, int]:
    """Return how many there are, and how many of them are located precisely."""
    return len(landmarks), int((landmarks.deviation_m <= PRECISE_M).sum())


def are_alike(views: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell of poses (N, 4, 4) and others (M, 4, 4) which see the same (N, M)."""
    off = se3.inverse(views)[:, None] @ others[None]
    is_near = np.linalg.norm(off[..., :3, 3], axis=-1) <= _VIEW_M
    return np.asarray(is_near & (se3.rotation_angle_rad(off) <= _VIEW_RAD))
