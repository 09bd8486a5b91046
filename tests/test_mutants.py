"""A sample of the mutants of the shipped configurations, and what is checked of them."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from hydra import initialize_config_module
from omegaconf import OmegaConf

from sceneslam.config.build import build
from sceneslam.config.resolve import composed, resolved
from sceneslam.experiments.mutants.bases import SCENARIOS, bases
from sceneslam.experiments.mutants.experiment import judged
from sceneslam.experiments.mutants.mutations import Subject, component_mutants, misspelt
from sceneslam.experiments.mutants.recordings import write_recordings
from sceneslam.experiments.mutants.table_mutations import table_mutants
from sceneslam.types.errors import ConfigError

SAMPLED = ("bright_to_dark", "policy", "recording", "two_rooms", "laser", "tum_rgbd", "rerun")


@pytest.fixture(autouse=True)
def hydra():
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        yield


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    write_recordings(folder)
    return folder


def mutants_of(base):
    tree, rng = composed(base.overrides), np.random.default_rng(0)
    subject = Subject(name=base.name, composed=tree, resolved=resolved(tree))
    if base.part:
        return list(component_mutants(subject, tuple(base.part.split(".")), rng))
    return list(table_mutants(subject, rng))


@pytest.mark.parametrize("name", SAMPLED)
def test_mistakes_are_named_before_the_first_frame_and_valid_changes_are_not(recordings, name):
    (base,) = (base for base in bases(recordings) if base.name == name)
    mutants = mutants_of(base)
    drawn = np.random.default_rng(1).permutation(len(mutants))[:40]
    findings = [judged(mutants[index]) for index in drawn]
    assert any(one.mutant.named for one in findings)
    assert [(one.mutant.change, one.said) for one in findings if not one.is_right] == []


def test_every_shipped_component_and_scenario_is_mutated(recordings):
    found = bases(recordings)
    with_options = {override for base in found for override in base.overrides}
    assert {f"+scenario={name}" for name in (*SCENARIOS, "single")} <= with_options
    named = {word.rpartition("=")[2] for word in with_options}
    named |= {"two_rooms", "one_scene", "default", "recording", "rerun", "none"}  # by default
    named |= {"detect_only", "video"}  # builds no modules; none lives on images alone
    named |= {"onnx", "indoor_outdoor"}  # need a network's file
    named |= {"process", "orb_slam3"}  # need a program that the user's word allows
    named |= {"ros2", "ros2_node", "realsense"}  # need a robot, a node, a camera
    named |= {"pipelined"}  # needs a system of the user's
    named |= {"light_mean", "exposure_times", "laps"}  # need an exposure, a recorded lap
    named |= {"genz_icp", "rko_lio"}  # need an extra
    named |= {"failures", "sensor_failure"}  # in a scenario
    for group in ("source", "detector", "effects", "policy", "atlas", "run", "slam", "sinks"):
        assert options(group) <= named, group


def options(group):
    from importlib.resources import files

    folder = files("sceneslam.conf") / group
    return {path.name.removesuffix(".yaml") for path in folder.iterdir() if "." in path.name}


def test_an_accepted_mistake_a_refused_valid_one_and_a_wrong_key_count_as_slipped():
    tree = composed(["+scenario=single"])
    subject = Subject(name="single", composed=tree, resolved=resolved(tree))
    broken = {**tree, "seed": "many"}
    assert not judged(subject.mutant("any", "none", tree, "seed")).is_right
    assert not judged(subject.mutant("any", "seed", broken)).is_right
    assert not judged(subject.mutant("any", "seed", broken, "policy")).is_right


def test_a_misspelt_name_is_another_name():
    rng = np.random.default_rng(0)
    for name in ("seed", "aa", "x", "confirm_window_s"):
        assert all(misspelt(name, rng) != name for _ in range(20))


def config(*overrides, **changes):
    return resolved({**composed(["+scenario=bright_to_dark", *overrides]), **changes})


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"slam": 7}, "slam"),
        ({"scenes": ["Bright"]}, "scenes"),
        ({"sinks": "rerun"}, "sinks"),
    ],
)
def test_a_table_of_the_top_level_is_a_table(changes, key):
    with pytest.raises(ConfigError) as caught:
        build(config(**changes))
    assert caught.value.key == key


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ("policy.gate.sigmas=-1", "policy.gate.sigmas"),
        ("evaluation.correct_limit_m=inf", "evaluation.correct_limit_m"),
        ("policy.gate=many", "policy.gate"),
        ("policy.gate._target_=sceneslam.bus.judging.gate.Gate", "policy.gate.sigmas"),
        ("slam.bright.cloud_voxel_m=nan", "slam.bright.cloud_voxel_m"),
        ("source.camera.fov_deg=wide", "source.camera.fov_deg"),
        ("source.camera.rate_hz=true", "source.camera.rate_hz"),
        ("slam.dark.height_min_m=0.5 slam.dark.height_max_m=0.4", "slam.dark.height_max_m"),
    ],
)
def test_a_mistake_deep_inside_is_named_by_its_full_key(change, key):
    with pytest.raises(ConfigError) as caught:
        build(config(*change.split()))
    assert caught.value.key == key


def test_an_inner_component_of_another_kind_is_refused():
    tree = config()
    limits = {"_target_": "sceneslam.atlas.atlas.Atlas", "voxel_m": 0.02}
    tree["policy"]["gate"] = limits
    with pytest.raises(ConfigError, match=r"policy\.gate: got 'sceneslam\.atlas\.atlas\.Atlas'"):
        build(tree)


def test_scenes_without_a_fallback_and_rows_nobody_asks_for_are_said(caplog):
    tree = config()
    tree["scenes"] = {"Bright": ["bright", "dark"], "Dark": ["dark"], "Dusk": ["dark"]}
    with caplog.at_level(logging.WARNING):
        build(tree)
    assert [record.getMessage() for record in caplog.records] == [
        "scenes.Dark: dark has no fallback; without it, poses are bridged until another scene",
        "scenes.Dusk: the detector does not report this scene",
    ]


def test_plain_values_resolve_as_composed_ones_do():
    tree = composed(["+scenario=single", "seed=7"])
    assert tree["source"]["seed"] == "${seed}"
    assert resolved(tree) == resolved(OmegaConf.create(tree))
    assert resolved(tree)["source"]["seed"] == 7
