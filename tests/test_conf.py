"""Every YAML that is shipped fits the code it names."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
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


def test_every_slam_module_is_listed_with_its_licence_and_what_it_needs():
    page = (ROOT / "docs" / "modules.md").read_text()
    rows = {line.split("`")[1]: line.split("|") for line in page.splitlines() if line[:3] == "| `"}
    for module in options("slam"):
        assert all(cell.strip() for cell in rows[module][1:-1]), module


@pytest.mark.parametrize("group", ["effects", "policy"])
def test_targets_of_earlier_configurations_are_found_where_they_are_now(group):
    for option in set(options(group)) - {"passer_by"}:  # was never elsewhere
        config = composed(f"{group}={option}", "source=two_rooms")
        now = OmegaConf.to_yaml(config[group])
        for folder in ("sources.changes.", "bus.judging.", "bus.scene."):
            now = now.replace(folder, folder.partition(".")[0] + ".")
        for key, node, positional in nodes({group: yaml.safe_load(now)}):
            check_node(node, key, allow=[], positional=positional)
