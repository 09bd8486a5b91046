"""Every YAML that is shipped fits the code it names; imports run one way."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from sceneslam.config.check import check_keys, check_node

ROOT = Path(__file__).parents[1]
GROUPS = ("source", "detector", "policy", "atlas", "run", "evaluation", "effects")
SCENARIOS = sorted(path.stem for path in (ROOT / "conf" / "scenario").glob("*.yaml"))
EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml"))


def composed(*overrides):
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        config = compose("config", overrides=list(overrides))
        return OmegaConf.to_container(config, resolve=True, throw_on_missing=False)


def options(group):
    return sorted(path.stem for path in (ROOT / "conf" / group).glob("*.yaml"))


def nodes(config):
    """Yield every component of a configuration with its key."""
    for group in GROUPS:
        if config.get(group):
            yield group, config[group], 1 if group == "effects" else 0
    for group in ("slam", "sinks"):
        for key, node in (config.get(group) or {}).items():
            yield f"{group}.{key}", node, 0


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_scenario_composes_and_fits_its_targets(scenario):
    config = composed(f"+scenario={scenario}", "source=two_rooms")
    check_keys(config)
    for key, node, positional in nodes(config):
        check_node(node, key, allow=[], positional=positional)
    for scene, keys in config["scenes"].items():
        assert set(keys) <= set(config["slam"]), scene


@pytest.mark.parametrize("group", ["source", "detector", "effects", "policy", "run"])
def test_every_option_of_a_group_fits_its_target(group):
    for option in options(group):
        config = composed("+scenario=single", f"{group}={option}")
        for key, node, positional in nodes(config):
            if key == group:
                check_node(node, key, allow=[], positional=positional)


@pytest.mark.parametrize("module", options("slam"))
def test_every_module_can_run_alone(module):
    node = composed("+scenario=single", f"slam@slam.only={module}")["slam"]["only"]
    check_node(node, "slam.only", allow=[])


def test_a_module_alone_is_not_held_against_odometry():
    assert composed("+scenario=single")["policy"]["gate"] is None
    assert composed("+scenario=bright_to_dark")["policy"]["gate"] is not None


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_experiment_composes(experiment):
    scenario = ["+scenario=bright_to_dark"] if experiment == "unswitched" else []  # any other too
    config = composed(*scenario, f"+experiment={experiment}")
    key = config.pop("experiment")
    if key is None:
        check_keys({**config, "reference": None})
    else:
        check_node(config[key], key, allow=[])


def test_every_folder_of_conf_is_a_group_that_config_yaml_or_a_scenario_uses():
    folders = {path.name for path in (ROOT / "conf").iterdir() if path.is_dir()}
    folders.discard("__pycache__")
    assert folders <= {*GROUPS, "slam", "sinks", "scenario", "experiment", "viewer"}


ALLOWED = {  # package -> what of ours it may import
    "sceneslam/types": {"types"},
    "sceneslam/ros": {"types", "ros"},
    "sceneslam/sources": {"types", "interfaces", "ros", "sources"},
    "sceneslam/sinks": {"types", "interfaces", "ros", "sinks"},
    "sceneslam/atlas": {"types", "interfaces", "atlas"},
    "sceneslam/supervision": {"types", "interfaces", "supervision"},
    "sceneslam/bus": {"types", "interfaces", "atlas", "bus"},
    "sceneslam/evaluation": {"types", "interfaces", "evaluation"},
    "sceneslam/detection": {"types", "interfaces", "bus", "config", "evaluation", "detection"},
    "sceneslam/collect": {"types", "evaluation", "collect", "sweep"},
    "modules": {"types", "interfaces"},
    "experiments/openloris": {"types", "evaluation", "experiments"},
    "experiments/handover": {"types", "atlas", "evaluation", "experiments"},
    "experiments/mutants": {"types", "interfaces", "ros", "config", "experiments"},
    "experiments/matrix": {"types", "evaluation", "bus", "modules", "experiments"},
    "experiments/paper": {"types", "interfaces", "evaluation", "config", "experiments"},
    "experiments/table": {"types", "evaluation", "experiments"},
    "experiments/tune": {"types", "evaluation", "experiments"},
}


@pytest.mark.parametrize("package", ALLOWED)
def test_imports_run_one_way(package):
    for path in (ROOT / package).rglob("*.py"):
        for name in imported(path):
            top, _, rest = name.partition(".")
            if top == "sceneslam" and rest:
                assert rest.split(".")[0] in ALLOWED[package], f"{path}: {name}"
            assert top not in ("modules", "experiments"), f"{path}: {name}"


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
