"""Did it work, where not, and what to change; and modules by their names."""

from __future__ import annotations

import pytest
from evaluation_runs import SETTINGS, poseless_run, switched_run, true_loop

from sceneslam.evaluation.metrics import evaluate
from sceneslam.evaluation.names import module_names, renamed
from sceneslam.evaluation.report.answer import answer
from sceneslam.types.rig import Sensor


def told(source=(), first_pose_s=0.0, **changes):
    metrics = evaluate(switched_run(), true_loop(), settings=SETTINGS)
    return answer(metrics | changes, [], source, first_pose_s=first_pose_s)


def test_a_good_run_is_told_in_one_sentence():
    found = told()
    assert found.kind == "worked" and not found.where and not found.advice
    share = "It worked: from the first pose on, 100.0 % of the observations have a pose"
    assert found.headline.startswith(share)


def test_a_first_pose_that_came_late_is_in_the_headline():
    late, early = (told(first_pose_s=at_s).headline for at_s in (15.0, 0.9))  # of 19.9 s
    assert "from the first pose on (at 15.0 of 19.9 s), 100.0 % of" in late
    assert "from the first pose on, 100.0 % of" in early


@pytest.mark.parametrize(
    ("changes", "advice"),
    [
        ({"bridged_why": {"while dark was lost": 50}, "correct_rate": 0.7}, "[dark,OTHER]"),
        ({"bridged_why": {"while dark was rejected": 50}}, "policy.gate=null"),
        ({"bridged_why": {"after a module failed": 50}}, "run.isolation=process"),
        ({"missing_why": {"without depth": 120}}, "without depth. Look at the sensor."),
        ({"missing_why": {"before a module tracked": 120}}, "came late"),
        ({"false_switches": 3}, "detector.threshold"),
    ],
)
def test_what_to_change_follows_from_what_went_wrong(changes, advice):
    found = told(**changes)
    assert advice in " ".join(found.advice) and len(found.advice) == 1


@pytest.mark.parametrize(
    ("changes", "where"),
    [
        ({"correct_rate": 0.7}, "correct for 70.0 % of the time"),
        ({"false_switches": 3}, "3 changes of module"),
        ({"shortfalls": ["`dark` failed once"]}, "`dark` failed once"),
    ],
)
def test_a_run_that_worked_in_part_says_where(changes, where):
    found = told(**changes)
    assert found.kind == "partly" and where in " ".join(found.where)


@pytest.mark.parametrize("sensor", [sensor.words for sensor in Sensor])
def test_a_tolerance_is_named_where_the_source_has_one(sensor):
    missing = {"missing_why": {f"without {sensor}": 120}}
    (without,) = told(source=("path",), **missing).advice
    (within,) = told(source=("path", "sync_tolerance_s"), **missing).advice
    assert without == f"At these times the module was without {sensor}. Look at the sensor."
    assert "sensor, or at source.sync_tolerance_s where" in within


def test_few_bridged_poses_ask_for_no_change():
    assert not told(bridged_why={"while dark was lost": 1}).advice


def test_a_run_without_a_pose_did_not_work():
    metrics = evaluate(poseless_run(observed=10), None, settings=SETTINGS)
    found = answer(metrics, ["the source ended early"], (), first_pose_s=0.0)
    assert found.kind == "failed" and found.where == ["the source ended early"]


def test_modules_get_their_names():
    slam = {
        "bright": {"_target_": "sceneslam.modules.slam.rgbd.module.Rgbd"},
        "laser": {"_target_": "sceneslam.modules.slam.laser.module.Laser"},
        "mine": {"_target_": "my_slam.Fast"},
        "none": None,
    }
    names = module_names(slam)
    assert names == {
        "bright": "rgbd (bright)",
        "laser": "laser",
        "mine": "Fast (mine)",
        "none": "none",
    }
    run = renamed(switched_run(), {"rgbd": "rgbd (bright)"})
    assert "rgbd (bright)" in run.modules and "rgbd" not in run.modules
    assert not any("rgbd" in (e.get("from"), e.get("to"), e.get("module")) for e in run.events)
