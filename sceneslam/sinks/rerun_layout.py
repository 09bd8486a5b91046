"""Layout of the Rerun viewer: entity paths, colours and the blueprint."""

from __future__ import annotations

from typing import Any

from sceneslam.types.rig import Rig

BASE, CAMERA, LASER = "world/base", "world/base/camera", "world/base/laser"
ONLINE, REVISED = "world/trajectory/online", "world/trajectory/revised"
TRUTH, MAP = "world/ground_truth", "world/map"
VALUE, VOTES, CONFIRMED, ERRORS = "plots/value", "plots/votes", "plots/confirmed", "plots/error"
POSTERIOR = "plots/posterior"
DECISIONS, TRACKING = "decisions", "tracking"
LEGEND = "legend"
BY_MODULE, AS_SEEN = f"{MAP}/modules", f"{MAP}/true"  # the map's points in two colourings
TIMELINE = "time"

# The palette of Okabe and Ito, as in the figures; grey: poses without a module.
PALETTE_RGB = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0))
BRIDGED_RGB, TRUTH_RGB = (119, 119, 119), (160, 160, 160)


def layout(rig: Rig, *, shown: str) -> Any:
    """Return the blueprint with views of map, camera, votes, errors and decisions.

    `shown`: BY_MODULE or AS_SEEN; the other one is hidden, and can be made visible.
    """
    import rerun.blueprint as rrb

    side: list[Any] = []
    if rig.camera is not None:
        side.append(rrb.Tabs(_image("image"), _image("depth")))
    side.append(
        rrb.Tabs(
            rrb.TimeSeriesView(origin=f"/{VALUE}", name="detector's value"),
            rrb.TimeSeriesView(origin="/plots", contents=_scenes(), name="votes and scene"),
            rrb.TimeSeriesView(origin=f"/{ERRORS}", name="errors [m]"),
        )
    )
    side.append(
        rrb.Tabs(
            rrb.TextLogView(origin=f"/{DECISIONS}", name="decisions"),
            rrb.TextLogView(origin=f"/{TRACKING}", name="tracker states"),
            rrb.Spatial2DView(origin=f"/{LEGEND}", name="colours"),
        )
    )
    # The trajectory is logged in increments: show all of them up to the time cursor.
    past = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    seen = ["$origin/**", f"- /{CAMERA}/depth"]  # its points would hide the map's colours
    hidden = AS_SEEN if shown == BY_MODULE else BY_MODULE
    overrides = {ONLINE: past, hidden: rrb.EntityBehavior(visible=False)}
    space = rrb.Spatial3DView(origin="/world", contents=seen, name="map", overrides=overrides)
    views = rrb.Horizontal(space, rrb.Vertical(*side), column_shares=[3, 2])
    # Opens at the end, with the whole path visible.
    at_end = rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following")
    return rrb.Blueprint(views, at_end, collapse_panels=True)


def _image(name: str) -> Any:
    import rerun.blueprint as rrb

    return rrb.Spatial2DView(origin=f"/{CAMERA}", contents=[f"/{CAMERA}/{name}"], name=name)


def _scenes() -> list[str]:
    return [f"/{VOTES}/**", f"/{POSTERIOR}/**", f"/{CONFIRMED}/**"]
