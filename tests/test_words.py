"""What people type: paths as they are, code that nobody vouched for, values beyond reason."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from configured import config
from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf

from sceneslam.app import run
from sceneslam.config.check import check_node
from sceneslam.config.files import check_yaml
from sceneslam.config.words import check_trust, how_to_quote, readable, takes_rows
from sceneslam.script import composed
from sceneslam.sources.bag.open_recording import open_recording
from sceneslam.sources.tum_rgbd import TumRgbd
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.input_files import given_path, read_text
from sceneslam.types.trajectory import Trajectory

ROOT = Path(__file__).parents[1]
SINGLE = ("+scenario=single", "source=mcap", "source.path=room.mcap")


def call(folder, *words, **more):
    return subprocess.run(
        [sys.executable, "-m", "sceneslam", *words],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        text=True,
        timeout=300,
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **more},
    )


@pytest.mark.parametrize(
    "path",
    [
        "~/x.bag",
        "/x/scan (1).bag",
        "/x/a=1/s.bag",
        "/x/it's.bag",
        "/x/a,b.bag",
        "/x/[1].bag",
        "/x/größe.bag",
        "/x/#1 & more; so!.bag",
        'C:\\x\\"y"\\',
        "/x/plain.bag",
    ],
)
def test_path_is_read_as_it_is_typed(path):
    word = readable(f"source.path={path}", is_sweep=False)
    assert OverridesParser.create().parse_override(word).value() == path


@pytest.mark.parametrize("path", ["~/x.bag", "/x/scan (1).bag", "/x/it's.bag", "/x/a,b.bag"])
def test_a_script_gives_paths_as_the_command_line_does(tmp_path, path):
    own = tmp_path / "it's mine" / "policy"
    own.mkdir(parents=True)
    (own / "mine.yaml").write_text("defaults: [default]\nretry_s: 7.0\n")
    config = composed(("source=rosbag", f"source.path={path}", "policy=mine"), own.parent)
    assert config["source"]["path"] == path and config["policy"]["retry_s"] == 7.0


def own(folder, option, base="/slam/laser"):
    """Write an option of a user, a laser of 3 m, and return its file."""
    path = folder / f"{option}.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"defaults: [{base}@_here_, _self_]\nrange_max_m: 3.0\n")
    return path


@pytest.mark.parametrize(
    ("option", "told"),
    [
        ("slam/laser", "slam: got '{}', allowed: another name, as ours is read for laser"),
        ("policy/default", "policy: got '{}', allowed: another name, as ours is read for default"),
        (
            "slam/ros2/rtabmap",
            "slam: got '{}', allowed: another name, as ours is read for ros2/rtab",
        ),
    ],
)
def test_option_with_the_name_of_one_of_ours_is_refused(tmp_path, option, told):
    path = own(tmp_path, option)
    with pytest.raises(ConfigError) as caught:
        composed(("+scenario=single",), tmp_path)
    assert str(caught.value).startswith(told.format(path))
    assert f"`defaults: [/{option}@_here_]` bases yours on it" in str(caught.value)


@pytest.mark.parametrize("words", [["--config-dir", "mine"], ["hydra.searchpath=[file://mine]"]])
def test_command_line_refuses_an_option_with_the_name_of_one_of_ours(folder, words):
    own(folder / "mine", "slam/laser")
    done = call(folder, *words, *SINGLE, "hydra.run.dir=out")
    assert done.returncode == 2 and done.stderr.startswith("error: slam: got ")
    assert "mine/slam/laser.yaml" in done.stderr and done.stderr.count("\n") == 1
    assert not (folder / "out").exists()


@pytest.mark.parametrize("option", ["slam/mine", "slam/ros2/mine", "slam/mine/laser"])
def test_option_of_another_name_is_read(tmp_path, option):
    own(tmp_path, option)
    words = ("+scenario=single", f"slam@slam.only={option.removeprefix('slam/')}")
    assert composed(words, tmp_path)["slam"]["only"]["range_max_m"] == 3.0


def test_our_own_folder_and_a_copy_of_it_are_read(tmp_path):
    shutil.copytree(ROOT / "conf", tmp_path / "conf")
    for folder in (ROOT / "conf", tmp_path / "conf"):
        assert composed(("+scenario=single",), folder)["slam"]


def test_a_copy_of_our_folder_may_replace_it(tmp_path):
    mine = shutil.copytree(ROOT / "conf", tmp_path / "mine")
    laser = mine / "slam" / "laser.yaml"
    laser.write_text(laser.read_text().replace("range_max_m: 25.0", "range_max_m: 3.5"))
    words = ("+scenario=single", "slam@slam.only=laser", "--cfg", "job")
    done = call(tmp_path, "--config-path", str(mine), *words)
    assert done.returncode == 0 and "range_max_m: 3.5" in done.stdout


@pytest.mark.parametrize(
    ("words", "has_rows"),
    [
        (["evaluation.scenes={Hall: Bright}"], True),
        (["+evaluation.scenes.Hall=Bright", "evaluation.scenes.Tunnel=Dark"], True),
        (["detector=rules", "detector.values.dim=60"], True),
        (["detector=rules", "detector.rules.tunnel={scene: Tunnel}"], True),
        (["detector=rules", "detector.rules.dark.when.corner_count=[null, 1]"], True),
        (["policy.startup_s.dark=8"], True),
        (["scenes={Dark: [dark]}"], True),
        (["+experiment=tune", 'tune.train.mine=["seed=3"]'], True),
        (["detector=rules", "detector.rules.dark.wen={grey_mean: [null, 1]}"], False),
        (["policy.typo=1"], False),
        (["policy={typo: 1}"], False),
        (["source.camera.fow_deg=60"], False),
        (["slam.dark=depth"], False),
        (["typo=1"], False),
    ],
)
def test_rows_can_be_added_to_tables_of_any_names(words, has_rows):
    with (
        initialize_config_module("sceneslam.conf", version_base="1.3"),
        pytest.raises(HydraException, match="append to your config") as caught,
    ):
        compose("config", overrides=words)
    assert takes_rows(caught.value.__cause__.parent_node) is has_rows


def test_what_hydra_reads_stays_as_it_is():
    words = ['source.path="/x/s (1).bag"', "seed=1", "~sinks", "scenes.Any=[a,b]", "--help"]
    assert [readable(word, is_sweep=False) for word in words] == words
    assert readable("source.path=a.bag,b.bag", is_sweep=True) == "source.path=a.bag,b.bag"


def test_word_that_cannot_be_parsed_is_shown_as_it_can_be_typed():
    said = how_to_quote("story=it's", "no viable alternative")
    assert said.endswith("""type it in quotes: 'story="it'"'"'s"'""")


@pytest.mark.parametrize("value", ["[" * 3000, "[" + "x," * 9000 + "]"])
def test_word_beyond_reason_is_refused_before_it_is_parsed(value):
    with pytest.raises(ConfigError, match=r"^scenes.Any: got .* allowed: .{10,80}$"):
        readable(f"scenes.Any={value}", is_sweep=False)


def test_home_folder_is_found():
    assert given_path("~/x.bag") == Path.home() / "x.bag"
    with pytest.raises(InputError, match="a path is empty"):
        given_path(" ")
    assert given_path("~nobody-of-that-name/x") == Path("~nobody-of-that-name/x")


@pytest.mark.parametrize("given", [["subprocess"], ["mine", "os"], "${slam.packages}"])
def test_file_cannot_vouch_for_its_own_code(given):
    made = OmegaConf.create({"allow_targets": given, "slam": {"packages": ["other"]}})
    for words in ([], ["seed=1"], ["allow_targets=[mine]"], ["allow_targets=[]"]):
        with pytest.raises(ConfigError, match="the command line itself"):
            check_trust(made, words)


def test_command_line_can_vouch_for_code():
    made = OmegaConf.create({"allow_targets": ["mine"]})
    check_trust(made, ["seed=1", "allow_targets=[mine]"])
    check_trust(made, ["++allow_targets=['mine']"])
    check_trust(OmegaConf.create({"allow_targets": []}), ["seed=1"])


def test_scenario_that_vouches_for_code_runs_nothing(folder, tmp_path):
    (tmp_path / "mine" / "scenario").mkdir(parents=True)
    (tmp_path / "mine" / "scenario" / "evil.yaml").write_text(
        "# @package _global_\ndefaults: [single]\nallow_targets: [subprocess]\n"
        "evaluation: {_target_: subprocess.call, args: [touch, ran]}\n"
    )
    done = call(folder, "--config-dir", "mine", "+scenario=evil", *SINGLE[1:], "hydra.run.dir=out")
    assert done.returncode == 2 and "error: allow_targets: got ['subprocess']" in done.stderr
    assert not (folder / "ran").exists()


@pytest.mark.parametrize("target", ["os.system", "builtins.exec", "subprocess.call", "numpy.load"])
def test_message_proposes_no_library_as_code_to_trust(target):
    with pytest.raises(ConfigError) as error:
        check_node({"_target_": target}, "detector", allow=[])
    assert target.partition(".")[0] not in error.value.allowed


def test_message_proposes_a_package_of_ones_own():
    with pytest.raises(ConfigError, match=r"allow_targets=\[my_slam\]"):
        check_node({"_target_": "my_slam.Slam"}, "slam.only", allow=[])


def test_function_of_ours_is_no_component():
    """`make_source` would build what a table of its own allows."""
    node = {"_target_": "sceneslam.config.build.make_source", "config": {}, "builder": None}
    with pytest.raises(ConfigError, match="a class under sceneslam"):
        check_node(node, "source", allow=[])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a0: &a0 [x,x,x,x,x,x,x,x,x]\n", "holds more than 20000 values"),
        ("deep: " + "[" * 5000 + "]" * 5000, "nested deeper than 32 levels"),
        ("long: " + "x" * (1 << 21), "has 2097158 bytes"),
    ],
)
def test_yaml_beyond_reason_is_refused(tmp_path, text, sentence):
    if "&a0" in text:  # each level nine times the one before: a billion values
        text += "".join(f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 9))
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(InputError, match=sentence):
        check_yaml(tmp_path / "mine.yaml")


def test_every_file_of_ours_is_within_reason():
    for path in (ROOT / "conf").rglob("*.yaml"):
        check_yaml(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("run__threads", 100_000),
        ("policy__confirm_window_s", 1e308),
        ("policy__buffer_mb", 1e12),
        ("run__memory_limit_mb", 10**30),
    ],
)
def test_number_that_no_machine_has_is_refused(tmp_path, key, value):
    with pytest.raises(ConfigError, match=key.replace("__", ".")):
        run(config(**{key: value}), tmp_path / "out")


def test_pipe_and_device_are_no_recordings(tmp_path):
    os.mkfifo(tmp_path / "f.bag")
    for path in (tmp_path / "f.bag", Path("/dev/zero")):
        with pytest.raises(InputError, match="got a pipe or a device"):
            open_recording(path)
    os.mkfifo(tmp_path / "rgb.txt")
    with pytest.raises(InputError):
        TumRgbd(str(tmp_path), {}, 5000.0, [0.3, 8.0], 0.02)


def test_text_is_read_whatever_wrote_it(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbf1.0 a.png\r\n2.0 b.png\r\n# caf\xe9\r\n")
    assert read_text(tmp_path / "a.txt").splitlines()[:2] == ["1.0 a.png", "2.0 b.png"]
    (tmp_path / "b.txt").write_bytes("1.0 ä.png\r\n".encode("utf-16"))
    assert read_text(tmp_path / "b.txt").splitlines() == ["1.0 ä.png"]


@pytest.mark.parametrize("numbers", ["0 0 0 0 0 0 0", "1 2 3", "0 0 0 0 0 0 9", "0 0 0 nan 0 0 1"])
def test_line_that_is_no_pose_is_named(tmp_path, numbers):
    (tmp_path / "truth.txt").write_text(f"1.0 0 0 0 0 0 0 1\n2.0 {numbers}\n")
    with pytest.raises(InputError, match="line 2: expected `stamp tx ty tz qx qy qz qw`"):
        Trajectory.read_tum(tmp_path / "truth.txt")


def test_input_without_one_observation_is_nothing_that_was_run(tmp_path):
    (tmp_path / "0.bin").write_bytes(b"")
    words = ("+scenario=single", "source=kitti", "source.path=.", "slam@slam.only=recorded")
    (tmp_path / "poses.tum").write_text("1.0 0 0 0 0 0 0 1\n")
    words = (*words, "slam.only.path=poses.tum", "hydra.run.dir=out")
    done = call(tmp_path, *words)
    assert done.returncode == 2, done.stderr
    assert "error: no pose: the source gave no observation" in done.stderr


def test_version_is_ours(tmp_path):
    assert call(tmp_path, "--version").stdout.startswith("SceneSLAM ")


def test_full_disk_behind_standard_output_is_not_blamed_on_a_folder(tmp_path):
    with Path("/dev/full").open("w") as full:
        done = call(tmp_path, "--cfg", "job", stdout=full)
    assert done.returncode == 1 and done.stderr.startswith("error: standard output: OSError")
    assert len(done.stderr.splitlines()) == 1
