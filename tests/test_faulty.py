"""Modules and sources that fail on purpose fail as told, and only then."""

from __future__ import annotations

import json
import resource
from itertools import pairwise

import numpy as np
import pytest
from fakes import RIG, ClosingModule, ExactModule, FakeSource, observation

from sceneslam.interfaces import SlamModule, Source
from sceneslam.modules.slam.faulty import FaultyModule
from sceneslam.sources.changes.faulty import FaultySource
from sceneslam.sources.contract.ordered import Ordered
from sceneslam.types.errors import ConfigError
from sceneslam.types.fault_plan import FaultPlan
from sceneslam.types.observation import TrackingStatus


def module(record, *faults, **changes):
    values = {"rate_ratio": 0.1, "lasting_s": 0.3, "jump_m": 2.0, "seed": 3}
    faulty = FaultyModule(ExactModule(), list(faults), record=record, **(values | changes))
    faulty.activate(RIG)
    return faulty


def source(record, *faults, **changes):
    values = {"rate_ratio": 0.1, "lasting_s": 0.3, "clock_jump_s": 10.0, "seed": 3}
    inner = FakeSource(steps=200, dark_from=1000)
    return FaultySource(inner, list(faults), record=record, **(values | changes))


def struck(record):
    return [json.loads(line) for line in record.read_text().splitlines()]


@pytest.fixture
def record(tmp_path):
    return tmp_path / "faults.jsonl"


def test_without_faults_nothing_is_changed(record):
    faulty, sound = module(record, "raise", rate_ratio=0.0), ExactModule()
    sound.activate(RIG)
    assert isinstance(faulty, SlamModule) and faulty.requires == sound.requires
    for index in range(20):
        answer, expected = faulty.track(observation(index)), sound.track(observation(index))
        np.testing.assert_array_equal(answer.T_local_base, expected.T_local_base)
    assert not record.exists()


@pytest.mark.parametrize("inner", [ExactModule(), ClosingModule(False), ClosingModule(True)])
def test_a_faulty_module_closes_loops_if_the_module_does(record, inner):
    values = {"rate_ratio": 0.1, "lasting_s": 0.3, "jump_m": 2.0, "seed": 3}
    faulty = FaultyModule(inner, ["raise"], record=record, **values)
    assert faulty.closes_loops is getattr(inner, "closes_loops", False)


def test_faults_are_as_frequent_as_told_and_of_all_kinds(record):
    plan = FaultPlan(
        kinds=("one", "two"), known=("one", "two"), rate_ratio=0.2, seed=0, record=record
    )
    kinds = [plan.strike(stamp_ns) for stamp_ns in range(2000)]
    assert 150 <= kinds.count("one") <= 250 and 150 <= kinds.count("two") <= 250
    assert len(struck(record)) == 2000 - kinds.count(None)


def test_a_fault_strikes_once_whoever_is_there(record):
    def strikes():
        plan = FaultPlan(kinds=("one",), known=("one",), rate_ratio=0.5, seed=1, record=record)
        return [stamp_ns for stamp_ns in range(100) if plan.strike(stamp_ns)]

    assert strikes() and strikes() == []


def test_other_seeds_strike_elsewhere(tmp_path):
    found = []
    for seed in (1, 2):
        path = tmp_path / f"{seed}.jsonl"
        plan = FaultPlan(kinds=("one",), known=("one",), rate_ratio=0.3, seed=seed, record=path)
        found.append([stamp_ns for stamp_ns in range(100) if plan.strike(stamp_ns)])
    assert found[0] != found[1]


def test_an_exception_is_raised_where_it_strikes(record):
    faulty, raised = module(record, "raise"), []
    for index in range(100):
        try:
            faulty.track(observation(index))
        except RuntimeError:
            raised.append(observation(index).stamp_ns)
    assert raised and raised == [line["stamp_ns"] for line in struck(record)]


def test_nan_silence_and_jumps_are_what_they_say(record):
    for fault in ("nan", "silence", "jump"):
        path = record.with_suffix(f".{fault}")
        faulty, sound = module(path, fault, rate_ratio=0.05), ExactModule()
        sound.activate(RIG)
        answers = [faulty.track(observation(index)) for index in range(60)]
        poses = np.stack([answer.T_local_base for answer in answers])
        truth = np.stack([sound.track(observation(index)).T_local_base for index in range(60)])
        first = struck(path)[0]["stamp_ns"] // 10**8
        if fault == "nan":
            assert np.isnan(poses).any(axis=(1, 2)).sum() == len(struck(path))
        elif fault == "silence":
            lost = [answer.status is TrackingStatus.LOST for answer in answers]
            assert all(lost[first : first + 3]) and sum(lost) >= 3 * bool(struck(path))
        else:
            off_m = np.linalg.norm(poses[first:, :3, 3] - truth[first:, :3, 3], axis=1)
            assert (off_m > 1.9).all() and np.allclose(poses[:first], truth[:first])
            faulty.activate(RIG)
            T_local_base = faulty.track(observation(61)).T_local_base
            np.testing.assert_allclose(T_local_base, np.eye(4), atol=1e-9)


def test_memory_is_not_taken_where_there_is_no_limit(record):
    assert resource.getrlimit(resource.RLIMIT_DATA)[0] == resource.RLIM_INFINITY
    with pytest.raises(MemoryError, match="without a limit"):
        module(record, "memory", rate_ratio=1.0).track(observation(0))


def test_odometry_that_begins_anew_does_so_at_the_identity_and_moves_on(record):
    sound, seen = list(FakeSource(steps=200, dark_from=1000)), list(source(record, "reset"))
    for index in (round(line["stamp_ns"] / 1e8) for line in struck(record)):
        np.testing.assert_allclose(seen[index].T_odom_base, np.eye(4), atol=1e-9)
    T_new_old = [
        s.T_odom_base @ np.linalg.inv(f.T_odom_base) for s, f in zip(seen, sound, strict=True)
    ]
    changes = sum(not np.allclose(a, b) for a, b in pairwise(T_new_old))
    assert changes == sum(line["stamp_ns"] > 0 for line in struck(record)) > 0


def test_a_faulty_source_behind_the_repair_keeps_the_promises_of_a_source(record):
    faults = ("dropout", "blackout", "nan", "clock", "duplicate", "disorder")
    faulty = source(record, *faults, rate_ratio=0.2)
    assert isinstance(faulty, Source)
    seen = list(Ordered(faulty))
    assert {line["kind"] for line in struck(record)} == set(faults)
    assert (np.diff([one.stamp_ns for one in seen]) > 0).all()
    assert len(seen) >= 150
    for one in seen:
        assert one.T_odom_base is None or np.isfinite(one.T_odom_base).all()


def test_a_dropout_silences_one_sensor_for_a_while(record):
    seen = list(source(record, "dropout", rate_ratio=0.02))
    first = struck(record)[0]["stamp_ns"] // 10**8
    for one in seen[first : first + 3]:
        assert (one.image_bgr is None) != (one.T_odom_base is None)
    assert all(one.image_bgr is not None for one in seen[:first])


def test_a_second_run_in_the_same_folder_has_the_same_faults(record):
    stamps_ns, lines = [], []
    for _ in range(2):
        stamps_ns.append([one.stamp_ns for one in source(record, "clock", "duplicate")])
        lines.append([(line["stamp_ns"], line["kind"]) for line in struck(record)])
    assert lines[0] and lines[0] == lines[1]
    assert stamps_ns[0] == stamps_ns[1]


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"rate_ratio": 2.0}, "rate_ratio"),
        ({"lasting_s": -1.0}, "lasting_s"),
        ({"seed": -1}, "seed"),
    ],
)
def test_settings_that_make_no_sense_are_refused(record, changes, key):
    with pytest.raises(ConfigError, match=key):
        module(record, "raise", **changes)
    with pytest.raises(ConfigError, match=key):
        source(record, "clock", **changes)
    with pytest.raises(ConfigError, match="faults: got 'explode'"):
        module(record, "explode")
