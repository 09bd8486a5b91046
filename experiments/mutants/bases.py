"""The shipped configurations, each with the part of it that is mutated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

SCENARIOS = (
    "bright_to_dark",
    "dark_to_bright",
    "there_and_back",
    "lights_out",
    "flicker",
    "white_wall",
    "dark_corridor",
    "depth_dropout",
    "failing_sensors",
)
EXPERIMENTS = (
    "faults",
    "handover",
    "matrix",
    "mutants",
    "paper_iv_a",
    "paper_iv_b",
    "paper_iv_c",
    "paper_iv_d",
    "paper_iv_e",
    "table",
)
_CAMERA = tuple(f"source.camera.{key}=30.0" for key in ("fx", "fy", "cx", "cy"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Base:
    """A valid configuration."""

    name: str
    overrides: Sequence[str]
    part: str  # the dotted key below which it is mutated; "" for the table and the top level


def bases(folder: Path) -> list[Base]:
    """Return a base for every scenario and every component; recordings are those of `folder`."""
    paths = {
        "tum_rgbd": folder / "tum",
        "kitti": folder / "kitti",
        "carmen": folder / "carmen.clf",
        "rosbag": folder / "room.mcap",
        "mcap": folder / "room.mcap",
        "openloris": folder / "openloris",
    }
    modules = {"kitti": "kiss_icp", "carmen": "laser", "openloris": "odometry"}
    return [
        *(_scenario(name) for name in SCENARIOS),
        _single("single", ""),
        *(
            _single(name, "slam.only", f"slam@slam.only={name}")
            for name in ("rgbd", "laser", "depth", "direct", "kiss_icp", "odometry")
        ),
        _single(
            "recorded", "slam.only", "slam@slam.only=recorded", f"slam.only.path={folder}/path.tum"
        ),
        _single("two_rooms", "source"),
        _single("building", "source", "source=building"),
        *(
            _single(
                name,
                "source",
                f"source={name}",
                f"source.path={path}",
                f"slam@slam.only={modules.get(name, 'rgbd')}",
                *(_CAMERA if name == "tum_rgbd" else ()),
                *(("source.sequence=home-1-1",) if name == "openloris" else ()),
            )
            for name, path in paths.items()
        ),
        _single(
            "grey_mean", "detector", "detector=grey_mean", "+scenes={Bright:[only],Dark:[only]}"
        ),
        _single("manual", "detector", "detector=manual", "+scenes={Bright:[only],Dark:[only]}"),
        _single("one_scene", "detector"),
        _single("learned", "detector", "detector=learned", "+scenes={Bright:[only],Dark:[only]}"),
        _single(
            "rules",
            "detector",
            "detector=rules",
            "+scenes={Dark:[only],Blinded:[only],Plain:[only],Bright:[only]}",
        ),
        _single(
            "lights_out_effect",
            "effects",
            "effects=lights_out",
            "source=tum_rgbd",
            f"source.path={folder}/tum",
            *_CAMERA,
        ),
        _single("faults", "effects", "effects=faults"),
        _single("liars", "effects", "effects=liars"),
        _single("policy", "policy"),
        _single("bayes", "policy", "policy=bayes"),
        _single("atlas", "atlas"),
        _single("recording", "run"),
        _single("live", "run", "run=live"),
        _single("evaluation", "evaluation"),
        _single("rerun", "sinks.rerun"),
        _single("mcap_sink", "sinks.mcap", "+sinks@sinks.mcap=mcap"),
        _single("depth_gap", "effects", "effects=depth_gap"),
        _single("passer_by", "effects", "effects=passer_by"),
        *(Base(name=name, overrides=(f"+experiment={name}",), part=name) for name in EXPERIMENTS),
    ]


def _scenario(name: str) -> Base:
    return Base(name=name, overrides=(f"+scenario={name}",), part="")


def _single(name: str, part: str, *overrides: str) -> Base:
    return Base(name=name, overrides=("+scenario=single", *overrides), part=part)
