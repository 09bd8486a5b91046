"""The definitions of all stories."""

from __future__ import annotations

from collections.abc import Mapping

from sceneslam.sources.simulator.places import building
from sceneslam.sources.simulator.places.place import SUN
from sceneslam.sources.simulator.robot.motion import Drive, Face, Shift, Wait
from sceneslam.sources.simulator.story import OFF, Knots, Story

OFFICE_TOUR = "office_tour"
_TOUR_SPEED_MPS = 0.6


def find(name: str, order: int | None) -> Story:
    """Return a story by its name; `order` shuffles the rooms of the building."""
    if name != OFFICE_TOUR:
        return STORIES[name]
    dark = dict.fromkeys(building.dark_groups(), OFF)
    return Story(
        about="through a building in which every sensor fails somewhere, and back to the start",
        place="building",
        start_x_y_deg=(*building.START_XY_M, 0.0),
        moves=(Wait(2.0), Drive(building.tour(order), _TOUR_SPEED_MPS), Wait(1.0)),
        lamps={**dark, SUN: ((0.0, 1.0),)},
    )


def _drop_outs(*drops: tuple[float, float]) -> Knots:
    """Return the level's knots of a lamp that fails at each (time, duration) [s]."""
    knots: list[tuple[float, float]] = []
    for start, duration in drops:
        end = start + duration
        knots += [(start, 1.0), (start + 0.03, 0.0), (end - 0.03, 0.0), (end, 1.0)]
    return tuple(knots)


# Route through room A from the start to the door, turning into it at the end.
_TO_DOOR = ((2.75, 2.2), (2.7, 1.3), (3.1, 0.8), (3.6, 0.95), (3.8, 1.5), (4.0, 1.95), (5.06, 1.98))
# Route along the dividing wall in room B, turning into the door at the end.
_BACK_TO_DOOR = ((6.3, 3.3), (5.6, 3.3), (5.55, 2.3), (5.4, 2.02), (5.06, 1.98))
_ROUND_A = ((2.75, 2.2), (2.7, 1.3), (3.1, 0.8), (3.6, 0.95), (3.8, 1.6), (3.8, 2.3), (3.3, 2.75))

STORIES: Mapping[str, Story] = {
    "bright_to_dark": Story(
        about="from a lit room through the door into a dark one",
        moves=(
            Wait(1.5),
            Drive((*_TO_DOOR, (6.2, 2.0), (7.2, 2.05), (8.3, 2.3), (8.5, 1.7), (7.9, 1.25))),
            Wait(0.5),
        ),
    ),
    "dark_to_bright": Story(
        about="from a dark room through the door into a lit one",
        start_x_y_deg=(8.2, 1.5, 115.0),
        moves=(
            Wait(1.5),
            Drive(
                (
                    (8.0, 2.6),
                    (7.4, 3.25),
                    *_BACK_TO_DOOR,
                    (4.4, 1.95),
                    (3.5, 2.2),
                    (2.8, 1.9),
                    (2.8, 1.1),
                )
            ),
            Face(60.0),
            Wait(1.0),
        ),
    ),
    "there_and_back": Story(
        about="bright, dark, bright: a loop closed at the start",
        moves=(
            Wait(1.5),
            Drive((*_TO_DOOR, (6.2, 2.0), (7.3, 1.9), (8.3, 2.0), (8.2, 2.9), (7.4, 3.25))),
            Drive((*_BACK_TO_DOOR, (4.4, 1.97), (3.8, 2.5), (3.0, 2.9))),
            Face(-150.0),
            Wait(1.5),
        ),
    ),
    "lights_out": Story(
        about="the lamp is switched off while the robot drives",
        moves=(Wait(1.5), Drive(_ROUND_A), Face(-120.0), Drive(((2.75, 1.6),)), Wait(0.5)),
        lamps={"a": ((12.0, 1.0), (12.15, 0.0)), "b": OFF},
    ),
    "flicker": Story(
        about="the lamp fails for less than a second, again and again",
        moves=(Wait(1.5), Drive(_ROUND_A), Face(-120.0), Drive(((2.75, 1.6),)), Wait(0.5)),
        lamps={
            "a": _drop_outs(
                (4.0, 0.3), (7.5, 0.8), (9.3, 0.5), (13.0, 0.2), (13.9, 0.6), (19.0, 0.8)
            ),
            "b": OFF,
        },
    ),
    "white_wall": Story(
        about="lit, but for seconds nothing but a plain wall in view",
        place="bare_rooms",
        moves=(
            Wait(1.5),
            Drive(((2.8, 2.2), (2.9, 1.5), (3.0, 1.0)), 0.5),
            Face(-90.0),
            Shift(0.3),
            Wait(0.5),
            Face(-68.0, 25.0),
            Face(-108.0, 25.0),
            Shift(-0.2, 0.15),
            Face(-10.0),
            Drive(((3.5, 1.0), (3.8, 1.6), (3.8, 2.2), (3.3, 2.9))),
            Wait(0.5),
        ),
    ),
    "dark_corridor": Story(
        about="from a lit room into a dark, bare corridor without structure along its axis",
        place="corridor",
        moves=(Wait(1.5), Drive((*_TO_DOOR, (6.0, 1.98), (13.0, 1.98)), 0.45), Wait(0.5)),
    ),
    "depth_dropout": Story(
        about="sunlight through a window blinds the depth camera for some seconds",
        place="sunny_rooms",
        moves=(Wait(1.5), Drive(_ROUND_A), Face(-120.0), Drive(((2.75, 1.6),)), Wait(0.5)),
        lamps={"b": OFF, SUN: ((9.0, 0.02), (9.6, 1.0), (14.0, 1.0), (14.6, 0.02))},
    ),
}

NAMES = (*STORIES, OFFICE_TOUR)
