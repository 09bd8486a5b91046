"""Writing of ORB-SLAM3's settings file for a rig."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

_DEPTH_BASELINE_M = 0.08  # baseline of the virtual stereo pair, as in the published settings
_NEAR_BASELINES = 40.0  # depths within this many baselines count as near
_RATE_HZ = 30  # of images; largest time between keyframes

_TEXT = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {fx:.6f}
Camera1.fy: {fy:.6f}
Camera1.cx: {cx:.6f}
Camera1.cy: {cy:.6f}
Camera1.k1: {k1:.8f}
Camera1.k2: {k2:.8f}
Camera1.p1: {p1:.8f}
Camera1.p2: {p2:.8f}
Camera1.k3: {k3:.8f}
Camera.width: {width}
Camera.height: {height}
Camera.fps: {rate}
Camera.RGB: 0
Stereo.ThDepth: {near:.1f}
Stereo.b: {baseline:.4f}
RGBD.DepthMapFactor: 1.0
ORBextractor.nFeatures: {features}
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: {fast}
ORBextractor.minThFAST: {fast_min}
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def write_settings(rig: Mapping[str, Any], path: Path, *, features: int, fast: int) -> None:
    """Write the settings for the fields of a rig, with the published values for the rest."""
    k1, k2, p1, p2, k3 = rig["camera.distortion"].tolist()
    width, height = rig["camera.size_wh"].tolist()
    text = _TEXT.format(
        **{name: float(rig[f"camera.{name}"]) for name in ("fx", "fy", "cx", "cy")},
        **{"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3},
        width=width,
        height=height,
        rate=_RATE_HZ,
        near=_NEAR_BASELINES,
        baseline=_DEPTH_BASELINE_M,
        features=features,
        fast=fast,
        fast_min=max(fast // 3, 1),
    )
    path.write_text(text)
