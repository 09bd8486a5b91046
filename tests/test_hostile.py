"""Components that break every promise they can: the run goes on, and says what was wrong."""

import os
import re
import threading
import time
from contextlib import suppress
from copy import deepcopy
from pathlib import Path

import hostile
import numpy as np
import pytest
from configured import config
from driving import assert_exact, dark_from, drive, events
from fakes import RIG, ExactModule, IdleSink, LiveFeedSource
from hostile_parts import Clears
from isolation import isolating
from test_isolation import active, drive_into, seen

from sceneslam.app import run
from sceneslam.atlas.atlas import Atlas
from sceneslam.engine.open_sinks import OpenSinks
from sceneslam.modules.detectors.grey_mean import GreyMean
from sceneslam.types.errors import ConfigError, InputError, ModuleError, text_of

ERRORS = sorted(hostile.ERRORS.keys() - {"KeyboardInterrupt"})  # that one ends the run
RAISED = pytest.mark.parametrize(
    ("error", "said"), [("Exception", "Exception: as usual"), ("SystemExit", "SystemExit: 3")]
)
SOUND = {"covariance huge"}  # it may be so


@pytest.fixture
def isolated():
    with isolating() as isolated:
        yield isolated


def survives(module):
    """Drive with a module that fails at some time; return what the log says of it."""
    modules = {"bright": module, "dark": ExactModule()}
    _, atlas, log, _ = drive(modules, steps=60, scene_at=dark_from(40), handover="rewind")
    assert len(atlas.online) == 60
    assert_exact(atlas)
    return [event["what"] for event in events(log, "fault")]


@pytest.mark.parametrize("answer", hostile.ANSWERS)
def test_an_answer_that_is_none_costs_no_pose(answer):
    assert bool(survives(hostile.Answers(answer))) is (answer not in SOUND)


@pytest.mark.parametrize("error", ERRORS)
@pytest.mark.parametrize("method", ["activate", "set_pose", "set_scene", "track"])
def test_whatever_a_module_raises_costs_no_pose(error, method):
    (what,) = survives(hostile.Throws(error, method))
    assert what.startswith("slam.bright ")


@pytest.mark.parametrize("error", ERRORS)
@pytest.mark.parametrize("method", ["get_trajectory", "get_map", "shutdown"])
def test_whatever_a_module_raises_when_it_leaves_costs_no_pose(error, method, caplog):
    given = {"get_trajectory": "its revised trajectory", "get_map": "its map"}
    faults = survives(hostile.Throws(error, method))
    assert len(faults) == (method in given)
    assert all(f"slam.bright could not give {given[method]}" in fault for fault in faults)
    assert "slam.bright could not" in caplog.text


@pytest.mark.parametrize("layers", hostile.MAPS)
def test_a_map_that_is_none_is_left_out(layers, caplog):
    faults = survives(hostile.Leaves(layers=layers))
    is_sound = layers == "a cloud beyond all measure"
    assert len(faults) == (not is_sound)
    assert ("slam.bright could not give its map" in caplog.text) is not is_sound


@pytest.mark.parametrize("trajectory", hostile.TRAJECTORIES)
def test_a_trajectory_that_is_none_is_left_out(trajectory, caplog):
    faults = survives(hostile.Leaves(trajectory=trajectory))
    is_sound = trajectory == "stamps of another time"
    assert len(faults) == (not is_sound)
    assert ("slam.bright could not give its revised trajectory" in caplog.text) is not is_sound


@pytest.mark.parametrize(
    ("said", "text"),
    [
        ("no file:\n  a\r\n\nb\n", "ValueError: no file: a b"),
        ("/x/two  blanks", "ValueError: /x/two  blanks"),
        ("\n", "ValueError"),
    ],
)
def test_text_of_an_error_is_one_line(said, text):
    assert text_of(ValueError(said)) == text


@pytest.mark.parametrize(
    ("how", "what"),
    [
        ("throws", "RuntimeError: out of memory"),
        ("none", "get_scene returned NoneType, expected SceneVote"),
        ("a text", "get_scene returned str, expected SceneVote"),
        ("an unknown scene", "scene: got 'Fog', expected Bright, Dark or Unsure"),
        ("leaves", "SystemExit: 3"),
    ],
)
def test_a_detector_that_fails_is_stopped_and_its_last_scene_stays(tmp_path, how, what):
    detector = {"_target_": "hostile_parts.Votes", "how": how}
    finished = run(hostile_config(detector=detector), tmp_path)
    assert finished.faults == () and len(finished.trajectory) == 100
    (sentence,) = finished.metrics["shortfalls"]
    assert re.match(r"detector failed once at \d\.\d s: failed while voting: ", sentence)
    assert what in sentence


@pytest.mark.parametrize(
    ("how", "poses", "what"),
    [
        ("throw", 50, "unexpected ValueError: the driver crashed; saved so far"),
        ("leave", 50, "unexpected SystemExit: 3; saved so far"),
        ("nothing", 50, "observation left out, it has no stamp in nanoseconds: 50 times"),
        ("stamp_is_huge", 50, "observation left out, it has no stamp in nanoseconds: 50 times"),
        ("stamp_jumps_years", 100, "no observation for 315360000.1 s"),
        ("stamp_jumps_back_years", 50, "observation left out, its stamp repeats, runs backwards"),
        ("image_grows", 100, ""),
        ("image_is_grey", 100, ""),
        ("image_is_float", 100, ""),
        ("odometry_is_sheared", 100, "odometry is not a valid pose: 50 times"),
        ("odometry_is_far", 100, "odometry is not a valid pose: 50 times"),
        ("odometry_is_reset", 100, "odometry that jumps: 1 time"),
        ("odometry_is_infinite", 100, "odometry that is not finite: 50 times"),
    ],
)
def test_a_source_that_talks_nonsense_ends_what_it_spoils_and_no_more(tmp_path, how, poses, what):
    source = {"_target_": "hostile_parts.BreaksOff", "how": how}
    finished = run(hostile_config(source=source), tmp_path)
    assert len(finished.trajectory) == poses
    assert np.isfinite(finished.trajectory.T_world_base).all()
    assert any(what in fault for fault in finished.faults) or not what


@RAISED
def test_a_sink_that_cannot_be_opened_is_named_before_the_first_frame(tmp_path, error, said):
    tape = {"_target_": "hostile_parts.Fails", "method": "open", "error": error}
    with pytest.raises(InputError, match=rf"sinks\.tape could not be opened: {said}"):
        run(hostile_config(sinks={"tape": tape}), tmp_path)


def test_a_component_that_leaves_while_it_is_built_is_named(tmp_path):
    tape = {"_target_": "hostile_parts.Fails", "method": "__init__", "error": "SystemExit"}
    with pytest.raises(ConfigError, match=r"sinks\.tape: .* builds \(SystemExit: 3\)"):
        run(hostile_config(sinks={"tape": tape}), tmp_path)


def test_a_sink_that_cannot_be_opened_leaves_nothing_open(tmp_path, monkeypatch):
    closed = []
    monkeypatch.setattr(IdleSink, "close", lambda sink: closed.append("sink"))
    monkeypatch.setattr(GreyMean, "shutdown", lambda detector: closed.append("detector"))
    monkeypatch.setattr(Atlas, "finish", lambda atlas: closed.append("atlas"))
    tape = {"_target_": "hostile_parts.Fails", "method": "open"}
    with pytest.raises(InputError):
        run(hostile_config(sinks={"first": {"_target_": "fakes.IdleSink"}, "tape": tape}), tmp_path)
    assert closed == ["sink", "sink", "atlas", "detector"]


def test_a_sink_that_cannot_be_opened_leaves_no_live_source_open(tmp_path):
    sinks = {"tape": {"_target_": "hostile_parts.Fails", "method": "open"}}
    source = {"_target_": "fakes.LiveFeedSource", "steps": 100, "dark_from": 1000}
    with pytest.raises(InputError, match="could not be opened"):
        run(hostile_config(sinks=sinks, source=source, run__mode="live"), tmp_path)
    assert not LiveFeedSource.is_open


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, r"run\.mode: got 'recording'"),
        ({"run__mode": "live", "slam__bright": {"_target_": "fakes.DepthModule"}}, "slam.bright"),
        ({"run__mode": "live", "effects": {"_target_": "fakes.Mute"}}, "effects: got"),
    ],
)
def test_parts_that_do_not_fit_leave_no_live_source_open(tmp_path, monkeypatch, changes, said):
    monkeypatch.setattr(LiveFeedSource, "is_open", True)
    source = {"_target_": "fakes.LiveFeedSource", "steps": 100, "dark_from": 1000}
    with pytest.raises(ConfigError, match=said):
        run(config(source=source, **changes), tmp_path)
    assert not LiveFeedSource.is_open


def test_a_detector_that_cannot_be_activated_leaves_no_thread(tmp_path):
    before = threading.active_count()
    detector = {"_target_": "hostile_parts.Votes", "how": "throws at once"}
    with pytest.raises(ModuleError, match="no weights"):
        run(hostile_config(detector=detector), tmp_path)
    assert threading.active_count() == before


@pytest.mark.parametrize("method", ["write", "write_event", "write_truth", "close"])
@RAISED
def test_a_sink_that_fails_is_dropped(tmp_path, method, error, said):
    tape = {"_target_": "hostile_parts.Fails", "method": method, "error": error}
    finished = run(hostile_config(sinks={"tape": tape}), tmp_path)
    assert finished.faults == (f"sinks.tape stopped writing: {said}",)
    assert len(finished.trajectory) == 100 and (tmp_path / "map").is_dir()


@pytest.mark.parametrize("method", ["write", "write_event", "write_truth"])
def test_a_sink_that_fails_is_closed(tmp_path, monkeypatch, method):
    closed = []
    monkeypatch.setattr(IdleSink, "close", lambda sink: closed.append(sink))
    tape = {"_target_": "hostile_parts.Fails", "method": method}
    run(hostile_config(sinks={"tape": tape}), tmp_path)
    assert len(closed) == 1


def test_a_sink_that_changes_its_events_does_not_change_those_of_the_run(tmp_path):
    event = {"event": "vote", "stamp_ns": 0, "posterior": {"Dark": 1.0}}
    before, sinks = deepcopy(event), OpenSinks([])
    sinks.open({"tape": Clears()}, RIG, tmp_path)
    sinks.write_events([event])
    assert event == before


def hostile_config(**changes):
    allowed = ["fakes", "hostile", "hostile_parts"]
    return config(allow_targets=allowed, run__report=False, **changes)


@pytest.mark.parametrize(
    ("how", "what"),
    [
        ("die", "ended by itself with exit code 0"),
        ("wait_for_a_thread", "did not answer within 0.5 s"),
        ("stop", "did not answer within 0.5 s"),
        ("close_descriptors", "ended by itself with exit code 1"),
        ("babble", "sent an invalid reply"),
        ("fork_and_die", "ended by itself with exit code 1"),
    ],
)
def test_a_process_that_is_wrecked_is_named_and_survived(isolated, how, what):
    module = active(isolated(Wrecked(how), step_deadline_s=0.5))
    with pytest.raises(ModuleError, match=what):
        drive_into(module)
    assert active(module).track(seen(0)).T_local_base.shape == (4, 4)


class Wrecked:
    """Makes a module that harms its process at the third observation."""

    def __init__(self, how):
        self.how = how

    def __call__(self):
        return hostile.Wrecks(self.how, at=3)


@pytest.mark.parametrize(
    "how",
    [
        "use_up_descriptors",
        "log_megabytes",
        "ignore_signals",
        "signal_its_group",
        "start_a_thread_that_stays",
    ],
)
def test_a_process_that_harms_itself_alone_goes_or_is_ended(isolated, how):
    module = active(isolated(Wrecked(how)))
    try:
        drive_into(module)
    except OSError as error:
        assert "Too many open files" in str(error)
    module.close()


def test_what_a_module_does_to_its_surroundings_stays_in_its_process(isolated):
    before = Path.cwd(), dict(os.environ)
    drive_into(active(isolated(Wrecked("move"))))
    assert (Path.cwd(), dict(os.environ)) == before


@pytest.mark.parametrize("how", ["fork", "start_a_daemon"])
def test_processes_that_a_module_starts_end_with_it(isolated, how, monkeypatch):
    monkeypatch.setenv("HOSTILE", f"{how} of {os.getpid()}")
    module = active(isolated(Wrecked(how)))
    drive_into(module)
    assert marked(2)
    module.close()
    assert marked(0)


def marked(count):
    """Tell whether so many processes have this one's HOSTILE in their environment, or soon do."""
    deadline_s = time.monotonic() + 10.0
    while len(_marked()) != count and time.monotonic() < deadline_s:
        time.sleep(0.01)
    return len(_marked()) == count


def _marked():
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            state = (path / "stat").read_text().rpartition(") ")[2][0]
            is_ours = os.environ["HOSTILE"] in (path / "environ").read_text(errors="replace")
            found += [path.name] if is_ours and state not in "ZX" else []
    return found
