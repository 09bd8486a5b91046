"""The camera images at changes of scene or module, for the report."""

from __future__ import annotations

from collections.abc import Iterable

import cv2

from sceneslam.evaluation.report import markup
from sceneslam.types.run import Event, KeyMoment

_QUALITY = 80  # of the images in the page (JPEG)


def change_of(event: Event) -> str:
    """Return a change of scene or module in words, "" for any other event."""
    kind = event["event"]
    if kind == "scene":
        return f"scene {event['scene']} confirmed"
    if kind == "decision" and event.get("to"):
        return f"{event['to']} takes over ({event['reason']})"
    if kind == "tracking" and event["status"] == "lost":
        return f"{event['module']} is lost"
    return ""


def pictures(moments: Iterable[KeyMoment], start_ns: int) -> str:
    """Return the images as figures with the time since `start_ns` and what changed."""
    figures = []
    for moment in moments:
        is_encoded, data = cv2.imencode(
            ".jpg", moment.image_bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        )
        if is_encoded:
            time_s = (moment.stamp_ns - start_ns) * 1e-9
            changes = ", ".join(filter(None, map(change_of, moment.events))) or "the first image"
            figures.append(
                markup.picture(data.tobytes(), f"{time_s:.1f} s: {changes}", kind="jpeg")
            )
    return f'<div class="moments">{"".join(figures)}</div>' if figures else ""
