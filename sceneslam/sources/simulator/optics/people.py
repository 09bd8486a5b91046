"""People in a rendered view: upright cylinders with trousers, striped shirt and head."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.optics.camera import RenderedView
from sceneslam.sources.simulator.places.walker import Walker
from sceneslam.types.se3 import Transform

_SHIRT_RATIO, _HEAD_RATIO = 0.5, 0.86  # lower end, as share of the height
_TROUSERS, _SHIRT, _STRIPE, _HEAD = np.array(  # BGR
    [(60, 48, 40), (70, 90, 170), (190, 200, 205), (130, 160, 205)], np.float32
)
_STRIPE_M = 0.07

Values = NDArray[np.float32]


def add_people(
    view: RenderedView,
    people: Sequence[Walker],
    time_s: float,
    T_gt_cam: Transform,
    directions_cam: Values,
    levels: Mapping[str, float],
) -> None:
    """Draw people into a view, in place; `directions_cam` (H, W, 3) are its rays, with z = 1."""
    for person in people:
        ways = directions_cam.reshape(-1, 3) @ T_gt_cam[:3, :3].T.astype(np.float32)
        start = T_gt_cam[:3, 3].astype(np.float32)
        depth_m = _reach(person, time_s, start, ways)
        at = np.flatnonzero(depth_m < view.depth_m.reshape(-1))
        points = start + depth_m[at, None] * ways[at]
        outward = (points[:, :2] - person.position_m(time_s).astype(np.float32)) / person.radius_m
        lengths = np.linalg.norm(ways[at], axis=1)
        light = np.sqrt(person.light * levels[person.group])
        view.image_bgr.reshape(-1, 3)[at] = light * _colours(person, points[:, 2])
        view.depth_m.reshape(-1)[at] = depth_m[at]
        view.cosine.reshape(-1)[at] = np.abs((outward * ways[at, :2]).sum(axis=1)) / lengths
        view.blinded.reshape(-1)[at] = False


def reach_people(people: Sequence[Walker], time_s: float, rays: Values) -> Values:
    """Return the distance (N,) of rays (N, 6), gt, to the first person, in direction lengths."""
    reach = np.full(len(rays), np.inf, np.float32)
    for person in people:
        reach = np.minimum(reach, _reach(person, time_s, rays[0, :3], rays[:, 3:]))
    return reach


def _reach(person: Walker, time_s: float, start: Values, ways: Values) -> Values:
    """Return the distance (N,) at which rays from one point enter a person's cylinder, else inf.

    Solves |o + t d|^2 = r^2 for t, horizontally, with o from the cylinder's axis to the start.
    """
    offset = start[:2] - person.position_m(time_s).astype(np.float32)
    # a t^2 + 2 b t + c = 0; the nearer root is (-b - sqrt(b^2 - a c)) / a.
    a = np.maximum((ways[:, :2] ** 2).sum(axis=1), np.float32(1e-12))
    b = ways[:, :2] @ offset
    c = np.float32(offset @ offset - person.radius_m**2)
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    reach = (-b - root) / a
    height_m = start[2] + reach * ways[:, 2]
    is_met = (b * b > a * c) & (reach > 0.0) & (height_m >= 0.0) & (height_m < person.height_m)
    return np.asarray(np.where(is_met, reach, np.float32(np.inf)), np.float32)


def _colours(person: Walker, height_m: Values) -> Values:
    """Return the colours (N, 3) BGR of a person at heights (N,) [m]."""
    ratio = height_m / person.height_m
    is_stripe = (height_m // _STRIPE_M) % 2 == 0
    shirt = np.where(is_stripe[:, None], _STRIPE, _SHIRT)
    colours = np.where(ratio[:, None] < _SHIRT_RATIO, _TROUSERS, shirt)
    return np.asarray(np.where(ratio[:, None] < _HEAD_RATIO, colours, _HEAD), np.float32)
