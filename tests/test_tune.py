"""Tuning: a search that can be stopped, a winner that composes, a split that is held out."""

from __future__ import annotations

import json

import pytest
from hydra import compose, initialize_config_module
from told_runs import Told, teller

from sceneslam.experiments.tune.experiment import TuneExperiment
from sceneslam.experiments.tune.objective import Objective
from sceneslam.experiments.tune.overlay import write_overlay
from sceneslam.experiments.tune.space import read_space
from sceneslam.experiments.tune.study import Search
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import Trial, TrialResult
from sceneslam.types.trajectory import Trajectory

pytest.importorskip("optuna", reason="needs the extra `tune`")

SPACE = {
    "threshold": {"key": "detector.threshold", "low": 40.0, "high": 160.0},
    "window": {"key": "policy.confirm_window_s", "low": 0.1, "high": 4.0, "log": True},
    "handover": {"key": "policy.handover", "choices": ["cold", "rewind"]},
}


def off(number, drawn):
    """Return how far from threshold 90, window 1 s and `rewind` something is."""
    value = abs(drawn["detector.threshold"] - 90.0) + abs(drawn["policy.confirm_window_s"] - 1.0)
    return value + (drawn["policy.handover"] == "cold")


def search(folder, **changes):
    return Search(folder, read_space(SPACE), **{"seed": 3, "about": "off", **changes})


def test_a_search_that_was_stopped_goes_on_as_if_it_had_not_been(tmp_path):
    for name in ("through", "stopped"):
        (tmp_path / name).mkdir()
    through = search(tmp_path / "through")
    through.run(24, off)

    def stop(number, drawn):
        if number == 15:
            raise KeyboardInterrupt
        return off(number, drawn)

    with pytest.raises(KeyboardInterrupt):
        search(tmp_path / "stopped").run(24, stop)
    again = search(tmp_path / "stopped")
    assert len(again.scores) == 15
    again.run(24, off)
    assert again.scores == through.scores and again.best == through.best


def test_another_seed_is_another_search(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    one, two = search(tmp_path / "one"), search(tmp_path / "two", seed=4)
    one.run(3, off)
    two.run(3, off)
    assert one.scores != two.scores


def test_a_folder_is_not_taken_for_another_search(tmp_path):
    search(tmp_path)  # nothing was tried yet: it may be mended
    search(tmp_path, about="off by more").run(1, off)
    with pytest.raises(ConfigError, match=r"hydra\.run\.dir: got 'a folder with another search'"):
        search(tmp_path, about="something else")


@pytest.mark.parametrize(
    "node",
    [
        {"key": "a", "low": 2.0, "high": 1.0},
        {"key": "a", "low": 0.0, "high": 1.0, "log": True},
        {"key": "a", "lowest": 0.0},
        {"low": 0.0, "high": 1.0},
        "a",
    ],
)
def test_a_parameter_without_sense_is_named(node):
    with pytest.raises(ConfigError, match=r"space\.wrong"):
        read_space({"wrong": node})


def outcome(metrics, tmp_path=None):
    empty = Trajectory.empty()
    return TrialResult(
        trial=Trial(name="x"),
        folder=tmp_path,
        metrics=metrics,
        trajectory=empty,
        online=empty,
        faults=(),
    )


def test_objective_weighs_metrics_by_their_dotted_names():
    metrics = {
        "ate_rmse_m": None,
        "detector_us": {"median": 40.0},
        "switches": [{"delay_s": 1.0}, {"delay_s": None}, {"delay_s": 2.0}],
    }
    weights = {"detector_us.median": 1.0, "switches": 10.0, "switches.delay_s": 100.0}
    assert Objective(weights=weights, unknown=7.0).of(outcome(metrics)) == 40.0 + 30.0 + 150.0
    assert Objective(weights={"ate_rmse_m": 2.0}, unknown=7.0).of(outcome(metrics)) == 14.0
    with pytest.raises(ConfigError, match=r"objective\.weights\.ate_m: "):
        Objective(weights={"ate_m": 1.0}, unknown=7.0).of(outcome(metrics))


def test_the_overlay_composes_to_what_was_drawn(tmp_path):
    drawn = {"detector.threshold": 87.3, "policy.handover": "cold", "policy.retry_s": 0.5}
    path = tmp_path / "experiment" / "tuned.yaml"
    write_overlay(path, drawn, {"train": [2.0, 1.0], "held out": [3.0, 2.5]})
    assert "# held out: score 2.5, of the defaults 3\n" in path.read_text()
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        words = [f"hydra.searchpath=[file://{tmp_path}]", "+experiment=tuned"]
        config = compose("config", overrides=["+scenario=bright_to_dark", *words])
    assert config.detector.threshold == 87.3 and config.policy.handover == "cold"
    assert config.policy.confirm_window_s == 2.0


def tell(trial):
    """Score by the threshold alone: 90 is best for learning, 100 for what is held out."""
    drawn = dict(word.split("=") for word in trial.overrides)
    best = 100.0 if drawn["story"] == "unseen" else 90.0
    return Told(metrics={"error": abs(float(drawn.get("detector.threshold", 120.0)) - best)})


def test_tuning_reports_both_splits_and_never_learns_from_what_is_held_out(tmp_path):
    asked = []

    def note(trial):
        asked.append(trial.name)
        return tell(trial)

    experiment = TuneExperiment(
        space={"threshold": SPACE["threshold"]},
        objective=Objective(weights={"error": 1.0}, unknown=9.0),
        train={"seen": ["story=seen"]},
        held_out={"unseen": ["story=unseen"]},
        trials=30,
        seed=0,
    )
    verdict = experiment.run(teller(tmp_path / "runs", note), tmp_path)
    train, held_out = verdict.figures
    assert train.bound == 30.0 and train.value < 3.0
    assert held_out.bound == 20.0 and held_out.value == pytest.approx(10.0, abs=3.0)
    assert not any("unseen" in name for name in asked if name.startswith("trial_"))
    assert asked[:3] == ["trial_000/seen", "default/seen", "default/unseen"]  # all can be read
    assert len(verdict.table.rows) == 2
    assert (tmp_path / "search.png").stat().st_size > 5000
    lines = (tmp_path / "study.jsonl").read_text().splitlines()
    assert all(json.loads(line) for line in lines)


def test_a_recording_cannot_be_in_both_splits():
    with pytest.raises(ConfigError, match=r"held_out\.same"):
        TuneExperiment(
            space=SPACE,
            objective=Objective(weights={"error": 1.0}, unknown=9.0),
            train={"same": []},
            held_out={"same": []},
            trials=1,
            seed=0,
        )
