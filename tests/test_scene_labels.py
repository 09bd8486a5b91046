"""Labels from runs: which module was best when."""

from __future__ import annotations

import json
import re
import shlex
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from networks import footage

from sceneslam.modules.detectors.learned import Learned
from sceneslam.scenes.__main__ import main
from sceneslam.scenes.examples import Example, MeasuredExample
from sceneslam.scenes.label import Labels, cheapest
from sceneslam.scenes.train import train
from sceneslam.scenes.words import read_word, read_words
from sceneslam.script import composed
from sceneslam.types.trajectory import Trajectory

FIRST_NS = 10**12


def drive(drift_mps: np.ndarray) -> Trajectory:
    """Return a drive along x at 0.5 m/s, 10 Hz, sideways off by a drift."""
    stamps_ns = FIRST_NS + np.arange(len(drift_mps), dtype=np.int64) * 10**8
    T_world_base = np.tile(np.eye(4), (len(drift_mps), 1, 1))
    T_world_base[:, 0, 3] = 0.05 * np.arange(len(drift_mps))
    T_world_base[:, 1, 3] = np.cumsum(drift_mps) * 0.1
    return Trajectory(stamps_ns=stamps_ns, T_world_base=T_world_base)


def write_run(
    folder: Path,
    module: str,
    drift_mps: np.ndarray,
    *,
    recording: Path,
    has_truth: bool = True,
    lost_s: tuple[float, float] | None = None,
) -> None:
    folder.mkdir(parents=True)
    drive(drift_mps).write_tum(folder / "trajectory.tum")
    if has_truth:
        drive(np.zeros_like(drift_mps)).write_tum(folder / "groundtruth.tum")
    source = read_word(f"Any={recording} source.rate_hz=10").config["source"]
    config = {"source": source, "effects": None, "scenes": {"Any": [module]}}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    turns = zip(lost_s or (), ("lost", "tracking"), strict=False)
    events = [
        {"event": "tracking", "stamp_ns": FIRST_NS + round(at_s * 1e9), "status": status}
        for at_s, status in turns
    ]
    (folder / "events.jsonl").write_text("".join(f"{json.dumps(one)}\n" for one in events))
    rows = np.zeros((len(drift_mps), 22))
    rows[:, 0] = FIRST_NS * 1e-9 + np.arange(len(drift_mps)) * 0.1
    rows[:, 1] = (np.cumsum(np.abs(drift_mps)) * 0.1) ** 2  # its own variance of x
    np.savetxt(folder / "trajectory_covariance.txt", rows)


def film(folder: Path) -> Path:
    """Write ten seconds at 10 Hz, lit and then dark."""
    import cv2

    folder.mkdir(parents=True)
    for index in range(100):
        kind = "Indoor" if index < 50 else "Dark"
        cv2.imwrite(str(folder / f"{index:03d}.png"), footage(kind, index))
    return folder


@pytest.fixture(params=[True, False], ids=["truth", "own covariance"])
def runs(tmp_path, request) -> Path:
    """Two modules: one drifts in the second half, the other one in the first."""
    recording = film(tmp_path / "film")
    halves = np.repeat([0.001, 0.05], 50)
    for module, drift_mps in (("eyes", halves), ("laser", halves[::-1])):
        write_run(
            tmp_path / "runs" / module,
            module,
            drift_mps,
            recording=recording,
            has_truth=request.param,
        )
    return tmp_path / "runs"


def spans_of(path: Path) -> list[tuple[str, float]]:
    (one,) = Labels.read(path).recordings
    changes = [one.spans[0], *(b for a, b in zip(one.spans, one.spans[1:], strict=False))]
    found: list[tuple[str, float]] = []
    for span in changes:
        if not found or found[-1][0] != span.scene:
            found.append((span.scene, span.start_s))
    return found


def test_every_instant_gets_the_module_whose_error_grew_least(runs, tmp_path, capsys):
    assert main(["label", str(tmp_path / "labels.yaml"), str(runs)]) == 0
    (first, second) = spans_of(tmp_path / "labels.yaml")
    assert first == ("eyes", 0.0) and second[0] == "laser" and second[1] == pytest.approx(5, abs=1)
    assert '"+scenes={eyes:[eyes,laser],laser:[laser,eyes]}"' in capsys.readouterr().out


@pytest.mark.parametrize("runs", [True], indirect=True)
def test_labels_are_of_the_same_group_as_the_recording_by_another_path(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for path in runs.rglob("config.yaml"):
        path.write_text(path.read_text().replace(str(tmp_path / "film"), "./film"))
    assert main(["label", "labels.yaml", "runs"]) == 0
    first, *_ = read_words(["labels.yaml"])
    assert first.config["source"]["path"] == "./film"
    assert first.group == read_word(f"Any={tmp_path}/film").group
    assert str(tmp_path) not in (tmp_path / "labels.yaml").read_text()


@pytest.mark.parametrize("runs", [True], indirect=True)
def test_group_of_labels_is_where_the_recording_is_whatever_the_file_says(runs, tmp_path):
    path = tmp_path / "labels.yaml"
    assert main(["label", str(path), str(runs)]) == 0
    node = yaml.safe_load(path.read_text())
    node["recordings"][0]["group"] = "film"
    path.write_text(yaml.safe_dump(node))
    first, *_ = read_words([str(path)])
    assert first.group == read_word(f"Any={tmp_path}/film").group


@pytest.mark.parametrize("runs", [True], indirect=True)
def test_the_table_that_is_printed_composes_with_modules_of_these_names(runs, tmp_path, capsys):
    assert main(["label", str(tmp_path / "labels.yaml"), str(runs)]) == 0
    (line,) = re.findall(r"^table +(.*)$", capsys.readouterr().out, re.M)
    words = ["+slam@slam.eyes=rgbd", "+slam@slam.laser=laser", *shlex.split(line)]
    assert composed(tuple(words), None)["scenes"] == {
        "eyes": ["eyes", "laser"],
        "laser": ["laser", "eyes"],
    }


@pytest.mark.parametrize("runs", [True], indirect=True)
def test_instants_that_the_truth_does_not_cover_get_no_label(runs, tmp_path, capsys):
    for path in runs.rglob("groundtruth.tum"):  # from 2 s to 7 s, with a gap from 3 s to 4.5 s
        lines = path.read_text().splitlines(keepends=True)
        path.write_text("".join(lines[21:32] + lines[46:72]))
    assert main(["label", str(tmp_path / "labels.yaml"), str(runs)]) == 0
    (one,) = Labels.read(tmp_path / "labels.yaml").recordings
    labelled_s = [(span.start_s, span.end_s) for span in one.spans]
    assert labelled_s == [(3.5, 4.0), (4.0, 4.1), (5.5, 6.0), (6.0, 6.1)]
    for path in runs.rglob("groundtruth.tum"):
        path.write_text("".join(path.read_text().splitlines(keepends=True)[:2]))
    assert main(["label", str(tmp_path / "labels.yaml"), str(runs)]) == 2
    assert "the ground truth covers none of it" in capsys.readouterr().err


def test_labels_count_from_the_first_observation_where_the_poses_begin_later(runs, tmp_path):
    vote = {"event": "vote", "stamp_ns": FIRST_NS - 2 * 10**9, "scene": "Any", "value": None}
    for path in runs.rglob("events.jsonl"):
        path.write_text(f"{json.dumps(vote)}\n")
    assert main(["label", str(tmp_path / "labels.yaml"), str(runs)]) == 0
    first, second = spans_of(tmp_path / "labels.yaml")
    assert first == ("eyes", 2.0) and second[0] == "laser" and second[1] == pytest.approx(7, abs=1)


def test_a_change_that_costs_more_than_it_gains_is_not_made(runs, tmp_path, capsys):
    assert main(["label", str(tmp_path / "l.yaml"), str(runs), "--change-m", "1.0"]) == 0
    assert len(spans_of(tmp_path / "l.yaml")) == 1
    assert main(["label", str(tmp_path / "l.yaml"), str(runs), "--change-m", "-1"]) == 2
    assert "--change-m: got -1.0, allowed: 0 or more" in capsys.readouterr().err


def test_a_lost_module_is_never_the_best(tmp_path):
    recording, still = film(tmp_path / "film"), np.full(100, 1e-4)
    one, other = tmp_path / "runs" / "eyes", tmp_path / "runs" / "wheels"
    write_run(one, "eyes", still, recording=recording, lost_s=(3.0, 6.0))
    write_run(other, "wheels", np.full(100, 0.02), recording=recording)
    assert main(["label", str(tmp_path / "labels.yaml"), str(tmp_path / "runs")]) == 0
    scenes = spans_of(tmp_path / "labels.yaml")
    assert scenes == [("eyes", 0.0), ("wheels", 3.0), ("eyes", 6.0)]


def test_a_detector_is_trained_on_labels(runs, tmp_path, capsys):
    pytest.importorskip("sklearn", reason="the extra `learn` is not installed")
    assert main(["label", str(tmp_path / "labels.yaml"), str(runs)]) == 0
    words = [str(tmp_path / "model.yaml"), str(tmp_path / "labels.yaml")]
    assert main(["train", *words]) == 0
    assert main(["test", *words, "--sheet", str(tmp_path / "wrong.png")]) == 0
    said = capsys.readouterr().out
    assert float(re.findall(r"images: ([0-9.]+) % right", said)[-1]) >= 90.0


@given(
    st.lists(st.lists(st.floats(0, 1), min_size=3, max_size=3), min_size=1, max_size=6),
    st.floats(0, 1),
)
def test_no_other_choice_is_cheaper(costs, change):
    table = np.array(costs)

    def total(path):
        steps = sum(table[at, choice] for at, choice in enumerate(path))
        return steps + change * np.count_nonzero(np.diff(path))

    least = min(map(total, product(range(3), repeat=len(table))))
    assert total(cheapest(table, change)) == pytest.approx(least, abs=1e-9)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda runs: (runs / "eyes" / "config.yaml").unlink(), "config.yaml cannot be read"),
        (lambda runs: (runs / "eyes" / "trajectory.tum").write_text(""), "fewer than two poses"),
        (
            lambda runs: (runs / "eyes" / "config.yaml").write_text(
                "source: {}\nscenes: {A: [eyes, laser]}"
            ),
            "got eyes, laser, allowed: one module",
        ),
        (lambda runs: (runs / "eyes" / "trajectory.tum").unlink(), "two modules or more"),
    ],
)
def test_runs_that_cannot_be_compared_are_one_sentence(runs, tmp_path, capsys, change, told):
    change(runs)
    assert main(["label", str(tmp_path / "labels.yaml"), str(runs)]) == 2
    said = capsys.readouterr().err
    assert told in said and said.count("\n") == 1, said


@pytest.mark.parametrize("text", ["[]", "recordings: [{name: a}]", "a: [", "table: {}"])
def test_file_without_labels_is_refused(tmp_path, capsys, text):
    (tmp_path / "labels.yaml").write_text(text)
    assert main(["train", str(tmp_path / "m.yaml"), str(tmp_path / "labels.yaml")]) == 2
    assert "not a file of labels" in capsys.readouterr().err
    assert main(["train", str(tmp_path / "m.yaml"), str(tmp_path / "nothing.yaml")]) == 2
    assert "labels not found" in capsys.readouterr().err
    assert main(["label", str(tmp_path / "l.yaml"), str(tmp_path)]) == 2
    assert "no finished run" in capsys.readouterr().err


@pytest.mark.parametrize("is_empty", [True, False])
def test_a_run_without_truth_and_covariances_is_one_sentence(tmp_path, capsys, is_empty):
    recording = film(tmp_path / "film")
    for name in ("eyes", "laser"):
        folder = tmp_path / "runs" / name
        write_run(folder, name, np.full(100, 0.01), recording=recording, has_truth=False)
    path = tmp_path / "runs" / "laser" / "trajectory_covariance.txt"
    if is_empty:
        path.write_text("# stamp_s xx xy\n")
    else:
        path.unlink()
    assert main(["label", str(tmp_path / "l.yaml"), str(tmp_path / "runs")]) == 2
    said = capsys.readouterr().err
    assert "neither ground truth nor covariances" in said and said.count("\n") == 1


def labelled(scene, values, weight, group=None):
    """Return an example of one feature, whose images have a weight each."""
    named = {"scene": scene, "group": group or scene, "name": scene}
    count = len(values)
    return MeasuredExample(
        example=Example(**named, parts=[], config={}, is_weighted=True),
        features=np.array(values)[:, None],
        weights=np.full(count, weight),
        thumbnails=[None] * count,
    )


def test_what_a_label_gains_is_no_likelihood(tmp_path):
    pytest.importorskip("sklearn", reason="the extra `learn` is not installed")
    path, values = tmp_path / "model.yaml", [-1.0, 0.0, 1.0]  # they tell nothing of the scene
    seen = [
        labelled(scene, values, weight, group)
        for group in ("a", "b")
        for scene, weight in (("eyes", 5.0), ("laser", 1.0))
    ]
    train(seen, ["q50"]).model.write(path, [])
    vote = Learned(str(path)).decide(0, np.array([0.5]))
    assert vote.scene == "eyes" and vote.value == pytest.approx(5.0 / 6.0, abs=0.01)
    assert vote.likelihoods["eyes"] == pytest.approx(0.5, abs=0.01)


def test_a_scene_whose_labels_gain_nothing_has_finite_likelihoods(tmp_path):
    pytest.importorskip("sklearn", reason="the extra `learn` is not installed")
    path = tmp_path / "model.yaml"
    seen = [labelled("eyes", [0.9, 1.1], 1.0), labelled("laser", [-0.9, -1.1], 0.0)]
    train(seen, ["q50"]).model.write(path, [])
    vote = Learned(str(path)).decide(0, np.array([1.0]))
    assert vote.scene == "eyes" and sum(vote.likelihoods.values()) == pytest.approx(1.0)


def test_a_label_that_gains_nothing_does_not_lower_the_certainty():
    pytest.importorskip("sklearn", reason="the extra `learn` is not installed")
    right = [
        labelled(scene, [value] * 20, 1.0, group)
        for group in ("a", "b")
        for scene, value in (("eyes", 1.0), ("laser", -1.0))
    ]
    wrong = [labelled("eyes", [-1.0] * 20, 1e-6, group) for group in ("a", "b")]
    assert train([*right, *wrong], ["q50"]).temperature == train(right, ["q50"]).temperature


def test_labels_of_modules_that_are_equally_good_are_trained_on(tmp_path):
    pytest.importorskip("sklearn", reason="the extra `learn` is not installed")
    examples = [labelled("eyes", [1.0] * 5, 0.0), labelled("laser", [-1.0] * 5, 0.0)]
    model = train(examples, ["q50"]).model
    assert (np.argmax(model.scores(np.array([[1.0], [-1.0]])), axis=1) == [0, 1]).all()
