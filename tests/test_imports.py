"""Imports run one way: packages import only what they may, in no circle; class names are unique."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAPPED = ("modules", "experiments")  # in `sceneslam` where it is installed
ESTIMATE = {"types", "interfaces", "motion", "scans", "views", "graphs", "executors"}
ALLOWED = {  # package -> what of ours it may import
    "sceneslam/types": {"types"},
    "sceneslam/motion": {"types", "motion"},
    "sceneslam/ros": {"types", "ros"},
    "sceneslam/sources": {"types", "interfaces", "ros", "sources"},
    "sceneslam/sinks": {"types", "interfaces", "ros", "sinks"},
    "sceneslam/atlas": ESTIMATE | {"atlas"},
    "sceneslam/scans": {"types", "scans"},
    "sceneslam/views": {"types", "views"},
    "sceneslam/graphs": {"types", "graphs"},
    "sceneslam/maps": {"types", "scans", "graphs", "atlas", "storage", "streams", "maps"},
    "sceneslam/testing": {"types", "interfaces", "answers", "testing"},
    "sceneslam/supervision": {"types", "interfaces", "supervision"},
    "sceneslam/storage": {"types", "interfaces", "storage"},
    "sceneslam/engine": {"types", "interfaces", "engine"},
    "sceneslam/bus": {"types", "interfaces", "answers", "motion", "executors", "storage", "bus"},
    "sceneslam/evaluation": {"types", "interfaces", "streams", "evaluation"},
    "sceneslam/scenes": {"types", "interfaces", "config", "streams", "evaluation", "scenes"},
    "sceneslam/detection": {
        "types",
        "interfaces",
        "bus",
        "storage",
        "config",
        "evaluation",
        "detection",
    },
    "sceneslam/collect": {"types", "streams", "evaluation", "collect"},
    "modules": ESTIMATE | {"supervision", "vocabulary", "ros", "modules"},
    "experiments/liars": {"types", "evaluation", "experiments"},
    "experiments/openloris": {"types", "evaluation", "experiments"},
    "experiments/one_map": {
        "types",
        "config",
        "scans",
        "views",
        "evaluation",
        "atlas",
        "testing",
        "experiments",
    },
    "experiments/handover": {"types", "atlas", "evaluation", "experiments"},
    "experiments/mutants": {"types", "interfaces", "ros", "config", "experiments"},
    "experiments/matrix": {"types", "evaluation", "bus", "modules", "experiments"},
    "experiments/paper": {"types", "interfaces", "evaluation", "config", "experiments"},
    "experiments/programs": {"types", "supervision", "modules", "experiments"},
    "experiments/table": {"types", "evaluation", "experiments"},
    "experiments/tune": {"types", "evaluation", "experiments"},
}


SLAM = {  # what more than one SLAM module may use
    "camera_certainty", "cloud_shape", "clouds", "degeneracy", "frame_log", "local", "model_error",
    "process", "surfaces", "cloud_odometry", "cloud_map", "voxel_cloud", "quiet"}  # fmt: skip


@pytest.mark.parametrize("package", ALLOWED)
def test_imports_run_one_way(package):
    for path in sources(package):
        for name in imported(path):
            top, _, rest = name.partition(".")
            if top == "sceneslam" and rest:
                assert rest.split(".")[0] in ALLOWED[package], f"{path}: {name}"
            assert top not in MAPPED, f"{path}: {name}"


def test_no_package_imports_one_that_imports_it():
    known = {}
    for path in sources("sceneslam"):
        package = path.relative_to(ROOT).with_suffix("").parts[1]
        tops = {name.split(".")[1] for name in imported(path) if name.startswith("sceneslam.")}
        known.setdefault(package, set()).update(tops - {package})
    while known:  # take away what imports nothing that is left
        free = {package for package, others in known.items() if not others & set(known)}
        assert free, f"imports run in a circle among {sorted(known)}"
        known = {package: known[package] for package in known.keys() - free}


def test_no_slam_module_reaches_into_another():
    for path in sources("modules/slam"):
        own = path.relative_to(ROOT / "modules" / "slam").with_suffix("").parts[0]
        for name in imported(path):
            parts = name.split(".")
            if parts[:3] == ["sceneslam", "modules", "slam"]:
                assert parts[3] in {own, *SLAM}, f"{path}: {name}"


def test_a_public_class_name_stands_for_one_thing():
    homes = {}
    for path in [*sources("sceneslam"), *sources("modules")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert not {name: paths for name, paths in homes.items() if len(paths) > 1}


def test_a_relative_import_is_seen(tmp_path):
    path = ROOT / "modules" / "slam" / "rgbd" / "some.py"
    assert resolved(path, ast.parse("from ..depth.motion import x").body[0]) == [
        "sceneslam.modules.slam.depth.motion.x"
    ]


def sources(package):
    return sorted((ROOT / package).rglob("*.py"))


def imported(path):
    """Yield the full name of everything that a file imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from resolved(path, node)


def resolved(path, node):
    """Return the full names that a `from` statement of a file imports."""
    package = list(path.relative_to(ROOT).parts[: -node.level or None]) if node.level else []
    if package and package[0] in MAPPED:
        package.insert(0, "sceneslam")
    base = ".".join([*package, *([node.module] if node.module else [])])
    return [f"{base}.{alias.name}" for alias in node.names]
