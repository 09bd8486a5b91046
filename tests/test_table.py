"""Which module for which scene: from motions to a scenario that composes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import PERIOD_NS, START_NS, happened, loop, stamps
from hydra import compose, initialize_config_module
from told_runs import Told, teller

from sceneslam.evaluation.association import select
from sceneslam.experiments.table.evidence import Evidence, propose, weigh
from sceneslam.experiments.table.experiment import TableExperiment
from sceneslam.experiments.table.overlay import write_scenario
from sceneslam.experiments.table.stretch import Motions, stretches_of
from sceneslam.types.errors import ConfigError
from sceneslam.types.trajectory import Trajectory

PAGE = Path(__file__).parents[1] / "experiments" / "table"
DARK_NS = START_NS + 100 * PERIOD_NS


def log(count=200):
    """Return the log of 20 s, the second half of which is dark, confirmed 2 s later."""
    votes = [happened("vote", int(ns), scene="-", value=0.0) for ns in stamps(count)]
    confirmed_ns = DARK_NS + 20 * PERIOD_NS
    bright = happened("scene", START_NS, scene="Bright", previous=None, since_ns=START_NS)
    dark = happened("scene", confirmed_ns, scene="Dark", previous="Bright", since_ns=DARK_NS)
    return [*votes, bright, dark]


def stretched(trajectory, scale):
    T_world_base = trajectory.T_world_base.copy()
    T_world_base[:, :3, 3] *= scale
    return Trajectory(stamps_ns=trajectory.stamps_ns, T_world_base=T_world_base)


def test_a_stretch_begins_with_the_first_image_that_shows_its_scene():
    bright, dark = stretches_of(log())
    assert (bright.scene, bright.begin_ns, bright.end_ns) == ("Bright", START_NS, DARK_NS)
    assert dark.begin_ns == DARK_NS and dark.end_ns > START_NS + 199 * PERIOD_NS


def motions(errors_m, due):
    return Motions(scene="Bright", due=due, trans_m=np.array(errors_m), rot_rad=np.zeros(0))


def test_what_is_missing_counts_as_much_as_the_worst():
    found = [motions([0.1, 5.0], due=4)]
    one = weigh("m", "Bright", found, recordings=1, lost_m=0.3, frame_ms=1.0)
    assert one.available == 0.5
    assert one.score_m == pytest.approx(np.sqrt((0.1**2 + 3 * 0.3**2) / 4))


def evidence(module, score_m, *, available=1.0, recordings=2):
    return Evidence(
        scene="Dark",
        module=module,
        recordings=recordings,
        due=10,
        available=available,
        error_m=score_m,
        error_rad=0.0,
        score_m=score_m,
        frame_ms=1.0,
    )


def test_the_best_that_suits_every_recording_comes_first():
    found = [
        evidence("lidar", 0.01, recordings=1),
        evidence("blind", 0.2, available=0.1),
        evidence("laser", 0.02),
        evidence("wheels", 0.05),
    ]
    assert propose(found, fallback_min=0.5) == {"Dark": ["laser", "wheels"]}


def experiment(**changes):
    values = {
        "recordings": {"drive": ["story=drive"]},
        "modules": ["seeing", "feeling", "absent"],
        "interval_s": 1.0,
        "lost_m": 0.3,
        "fallback_min": 0.5,
        "available_min": 0.95,
    }
    return TableExperiment(**{**values, **changes})


def tell(trial):
    """Give `seeing` no pose in the dark and `feeling` poses that are 5 % too far apart."""
    path = loop(200)
    module = trial.overrides[-1].partition("=")[2]
    if module == "absent":
        raise ConfigError("slam.only", module, "sensors that are there")
    own = select(path, np.arange(100)) if module == "seeing" else stretched(path, 1.05)
    metrics = {"modules": {"only": {"frame_ms": {"median": 9.0}}}}
    return Told(metrics=metrics, events=log(), truth=path, sessions={f"0_{module}": own})


def test_each_scene_gets_the_module_that_served_it_best(tmp_path):
    verdict = experiment().run(teller(tmp_path / "runs", tell), tmp_path)
    places = {row[:2]: row[2] for row in verdict.table.rows}
    assert places == {
        ("Bright", "seeing"): "first choice",
        ("Bright", "feeling"): "fallback 1",
        ("Dark", "feeling"): "first choice",
        ("Dark", "seeing"): "-",
    }
    assert verdict.holds and (tmp_path / "scores.png").stat().st_size > 5000
    text = (tmp_path / "conf" / "scenario" / "proposed.yaml").read_text()
    assert "  Bright: [seeing, feeling]\n  Dark: [feeling]\n" in text


@pytest.mark.parametrize("key", ["story", "slam.only.voxel_m"])
def test_a_mistake_in_a_setting_is_not_taken_for_a_missing_sensor(tmp_path, key):
    def tell(trial):
        raise ConfigError(key, -1, "something else")

    with pytest.raises(ConfigError, match=key):
        experiment().run(teller(tmp_path / "runs", tell), tmp_path)


def test_the_proposed_scenario_composes(tmp_path):
    table = {"Bright": ["rgbd", "laser"], "Dark": ["laser"]}
    write_scenario(tmp_path / "scenario" / "proposed.yaml", table, recordings=["one", "two"])
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        words = [f"hydra.searchpath=[file://{tmp_path}]", "+scenario=proposed"]
        config = compose("config", overrides=words)
    assert dict(config.scenes) == table and set(config.slam) == {"rgbd", "laser"}


def test_the_page_holds_what_the_commands_printed():
    page = (PAGE / "README.md").read_text()
    for name in ("five", "wheeled"):
        folder = PAGE / "results" / name
        assert (folder / "table.md").read_text() in page
        assert (folder / "proposed.yaml").read_text() in page
        assert f"(results/{name}/scores.png)" in page
