"""Mistakes in a configuration, each named before the first frame."""

import pytest
from configured import config

from sceneslam.app import run
from sceneslam.config.check import check_keys
from sceneslam.types.errors import ConfigError, InputError

BAD = {
    "an unknown key": ({"scenaro": "x"}, "scenaro: got 'x'"),
    "a decimal comma": ({"policy__gate": {"a_s": 1, 5: None}}, "policy.gate: got 5, allowed: keys"),
    "a number as a key within a list": ({"sinks": [{5: None}]}, "sinks[0]: got 5, allowed: keys"),
    "an unknown argument": ({"policy__confirm_windw_s": 1.0}, "policy.confirm_windw_s"),
    "a missing argument": ({"detector__threshold": ...}, "detector.threshold: got nothing"),
    "a value that was not given": ({"source__steps": "???"}, "source.steps: got nothing"),
    "a wrong type": ({"detector__threshold": "abc"}, "detector.threshold: got 'abc'"),
    "a flag for a number": ({"run__threads": True}, "run.threads: got True"),
    "a value out of range": ({"policy__confirm_window_s": -1.0}, "policy.confirm_window_s: got -1"),
    "a target that was not allowed": ({"detector___target_": "os.system"}, "detector._target_"),
    "a target that does not exist": (
        {"detector___target_": "sceneslam.modules.nothing.Nothing"},
        "detector._target_",
    ),
    "a target within a table": (
        {"source__fault": {"inner": {"_target_": "os.mkdir", "path": "x"}}},
        "source.fault.inner._target_: got 'os.mkdir'",
    ),
    "a target that leads through our code to another's": (
        {"slam__dark": {"_target_": "sceneslam.config.check.inspect.os.mkdir", "path": "x"}},
        "slam.dark._target_",
    ),
    "a key of Hydra's": ({"detector___partial_": True}, "detector._partial_: got True"),
    "a component that is no detector": (
        {"detector": {"_target_": "fakes.ExactModule"}},
        "allowed: a Detector, which has: quantity, get_scene",
    ),
    "a component that breaks without a word": (
        {"slam__dark": {"_target_": "fakes.Mute"}},
        "slam.dark: got 'fakes.Mute', allowed: a target that builds (AssertionError)",
    ),
    "no module": ({"slam": {}}, "slam: got nothing"),
    "a module's key with a slash": (
        {"slam": {"a/b": {"_target_": "fakes.ExactModule"}}},
        "slam: got 'a/b', allowed: a key that can be in the name of a file",
    ),
    "a module's key with a backslash": ({"slam": {"a\\b": None}}, r"slam: got 'a\\b', allowed: a"),
    "a module's key with a line feed": (
        {"slam": {"a\n": None}},
        r"slam: got 'a\n', allowed: a key",
    ),
    "a module's key beyond a file's name": ({"slam": {"ä" * 101: None}}, "at most 200 bytes"),
    "a scene without a module": ({"scenes__Dark": ...}, "scenes.Dark: got nothing"),
    "an unknown module in the table": ({"scenes__Dark": ["drak"]}, "scenes.Dark: got ['drak']"),
    "an empty list of modules": ({"scenes__Dark": []}, "scenes.Dark: got []"),
    "a name for a scene that the detector has not": (
        {"evaluation__scenes": {"Drak": "Night"}},
        "evaluation.scenes.Drak: got 'Night', allowed: a scene of the detector: Bright, Dark",
    ),
    "a module twice": ({"scenes__Dark": ["dark", "dark"]}, "scenes.Dark"),
    "an argument of the wrong kind": ({"slam__dark": 7}, "slam.dark: got 7"),
    "a sensor that the source lacks": (
        {"slam__dark": {"_target_": "fakes.DepthModule"}},
        "slam.dark: got 'DepthModule', allowed: a source with depth; this one has: image",
    ),
}


@pytest.mark.parametrize(("changes", "sentence"), BAD.values(), ids=BAD)
def test_mistake_is_named_before_the_first_frame(tmp_path, changes, sentence):
    with pytest.raises((ConfigError, InputError)) as caught:
        run(config(**changes), tmp_path / "run")
    assert sentence in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_a_key_of_the_top_level_that_is_a_number_is_named():
    with pytest.raises(ConfigError, match="the configuration: got 1, allowed: keys that are text"):
        check_keys({**config(), 1: 2})
