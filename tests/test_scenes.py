"""A detector that is trained on folders of images, and tested on others."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hydra import compose, initialize_config_module
from networks import footage
from ros_recordings import make_source

from sceneslam.config.component import ComponentBuilder
from sceneslam.config.resolve import resolved
from sceneslam.detection.run import detect
from sceneslam.interfaces import FeatureDetector
from sceneslam.scenes.__main__ import main
from sceneslam.scenes.examples import Example, MeasuredExample, Stretch, _Collected, look
from sceneslam.scenes.model import Model, fit
from sceneslam.scenes.score import table, write_sheet
from sceneslam.scenes.train import Judged
from sceneslam.scenes.words import read_word
from sceneslam.types.errors import InputError
from sceneslam.types.observation import UNSURE, Observation

pytest.importorskip("sklearn", reason="the extra `learn` is not installed")
KINDS = {"Bright": "Indoor", "Dark": "Dark"}


def write_images(folder: Path, kind: str, seeds: range) -> Path:
    folder.mkdir(parents=True)
    for seed in seeds:
        cv2.imwrite(str(folder / f"{seed:03d}.png"), footage(kind, seed))
    return folder


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("footage")
    for number in range(3):
        for scene, kind in KINDS.items():
            seeds = range(100 * number, 100 * number + 8)
            write_images(root / f"{scene}_{number}", kind, seeds)
    return root


@pytest.fixture(scope="module")
def model(folders) -> Path:
    words = [f"{scene}={folders}/{scene}_{k}" for k in (0, 1) for scene in KINDS]
    assert main(["train", str(folders / "model.yaml"), *words]) == 0
    return folders / "model.yaml"


def learned(path: Path | None, name: str = "detector") -> FeatureDetector:
    target = "sceneslam.modules.detectors.learned.Learned"
    node = {"_target_": target, "path": None if path is None else str(path)}
    return ComponentBuilder({name: node}).make(name, FeatureDetector)


def test_recordings_that_it_was_not_trained_on_get_their_scene(folders, model, capsys):
    sheet = folders / "wrong.png"
    words = [f"{scene}={folders}/{scene}_2" for scene in KINDS]
    assert main(["test", str(model), *words, "--sheet", str(sheet)]) == 0
    said = capsys.readouterr().out
    assert "all 16 images: 100.0 % right" in said and "wrong    0 images" in said
    assert not sheet.exists()
    assert [line.split() for line in said.splitlines()][-6:-3] == [
        ["true,", "voted", "Bright", "Dark"],
        ["Bright", "8", "0"],
        ["Dark", "0", "8"],
    ]


def test_images_that_are_wrong_are_counted_and_shown(folders, model, capsys, tmp_path):
    words = [f"Bright={folders}/Dark_2", f"Dark={folders}/Dark_1"]
    assert main(["test", str(model), *words, "--sheet", str(tmp_path / "wrong.png")]) == 0
    said = capsys.readouterr().out
    assert "all 16 images: 50.0 % right" in said and "wrong    8 images" in said
    sheet = cv2.imread(str(tmp_path / "wrong.png"))
    assert sheet.shape == (300, 960, 3) and sheet[:120, :160].mean() < 30  # a dark one


@pytest.mark.parametrize("name", ["wrong.xyz", "wrong"])
def test_a_sheet_that_is_no_image_is_named_before_a_recording_is_read(
    model, capsys, tmp_path, name
):
    missing = f"Dark={tmp_path / 'nowhere'}"
    assert main(["test", str(model), missing, "--sheet", str(tmp_path / name)]) == 2
    assert f"error: --sheet: got {tmp_path / name}, allowed: an image" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["folder.png", "file/wrong.png"])
def test_a_sheet_that_cannot_be_written_is_named_before_a_recording_is_read(
    model, capsys, tmp_path, monkeypatch, name
):
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("sceneslam.scenes.__main__.look", None)  # reading fails
    words = [f"Dark={tmp_path}", "--sheet", str(tmp_path / name)]
    assert main(["test", str(model), *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and str(tmp_path) in said and said.count("\n") == 1


def test_a_sheet_that_could_not_be_written_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(cv2, "imwrite", lambda *_: False)  # such as a full disk
    image = np.zeros((10, 16, 3), np.uint8)
    with pytest.raises(InputError, match=r"--sheet: got .*wrong\.png, which could not be written"):
        write_sheet([judged([[0.1, 0.8, 0.1]], [image])], tmp_path / "wrong.png")


def test_detector_votes_as_the_model_does_with_probabilities_that_sum_to_one(folders, model):
    detector, read = learned(model), Model.read(model)
    for folder in ("Bright_2", "Dark_2"):
        for observation in make_source("video", folders / folder):
            vote = detector.get_scene(observation)
            scores = read.scores(detector.get_features(observation)[None])[0]
            odds = np.log(vote.likelihoods["Bright"]) - np.log(vote.likelihoods["Dark"])
            at = [read.scenes.index(scene) for scene in ("Bright", "Dark")]
            assert odds == pytest.approx(scores[at[0]] - scores[at[1]], abs=1e-6)
            assert vote.scene == folder[:-2]
            assert vote.value == pytest.approx(max(vote.likelihoods.values()))
    assert detector.get_scene(Observation(stamp_ns=1)).scene == UNSURE


def test_what_was_recorded_together_is_held_out_together(folders, tmp_path, capsys):
    words = ["Bright:a={}/Bright_0", "Dark:a={}/Dark_0", "Bright:b={}/Bright_1", "Dark:b={}/Dark_1"]
    words = [word.format(folders) for word in words]
    assert main(["train", str(tmp_path / "model.yaml"), *words]) == 0
    assert "all 32 images" in capsys.readouterr().out
    assert main(["train", str(tmp_path / "one.yaml"), *words[:2]]) == 0
    said = capsys.readouterr().out
    assert "not calibrated" in said  # nothing would be left to train on
    assert "never held out: Bright, Dark" in said
    assert "divided" not in (tmp_path / "one.yaml").read_text()


def test_a_scene_that_was_never_held_out_is_named_and_has_no_rate(folders, tmp_path, capsys):
    words = [f"Bright={folders}/Bright_{k}" for k in (0, 1)] + [f"Dark={folders}/Dark_0"]
    assert main(["train", str(tmp_path / "model.yaml"), *words]) == 0
    assert "never held out: Dark\n" in capsys.readouterr().out
    comment = (tmp_path / "model.yaml").read_text()
    assert "not trained on: unknown." in comment and "# never held out: Dark\n" in comment


def test_one_recording_is_one_group_by_whatever_path_it_is_named(folders, monkeypatch):
    monkeypatch.chdir(folders)
    paths = ("Bright_0", "./Bright_0", f"{folders}/Bright_0/", "Dark_0/../Bright_0@0:5")
    assert len({read_word(f"Bright={path}").group for path in paths}) == 1


def test_probabilities_are_no_more_certain_than_held_out_recordings_bear(folders, tmp_path):
    """One of three recordings of a scene is labelled wrongly: certainty cannot be had."""
    words = [f"{scene}={folders}/{scene}_{k}" for k in (0, 1, 2) for scene in KINDS]
    assert main(["train", str(tmp_path / "right.yaml"), *words]) == 0
    write_images(tmp_path / "odd", "Dark", range(900, 908))
    assert main(["train", str(tmp_path / "odd.yaml"), *words, f"Bright={tmp_path}/odd"]) == 0
    image = next(iter(make_source("video", folders / "Bright_0")))
    right, odd = (learned(tmp_path / f"{name}.yaml").get_scene(image) for name in ("right", "odd"))
    assert right.scene == odd.scene == "Bright" and odd.value < right.value - 0.02


def test_part_of_a_film_is_an_example(tmp_path, folders, capsys):
    film = cv2.VideoWriter(
        str(tmp_path / "clip.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (160, 120)
    )
    for index in range(40):
        film.write(footage("Indoor" if index < 20 else "Dark", index))
    film.release()
    clip = tmp_path / "clip.mp4"
    words = [f"Bright={clip}@0:2", f"Dark={clip}@2:4"]
    assert main(["train", str(tmp_path / "model.yaml"), *words]) == 0
    assert main(["test", str(tmp_path / "model.yaml"), *words]) == 0
    said = capsys.readouterr().out
    assert "all 40 images: 100.0 % right" in said


def test_effects_make_an_example_of_a_recording(folders, model, capsys, tmp_path):
    dimmed = f"Dark={folders}/Bright_2 effects=lights_out lights=off"
    assert main(["test", str(model), dimmed, "--sheet", str(tmp_path / "wrong.png")]) == 0
    assert "all 8 images: 100.0 % right" in capsys.readouterr().out


def test_features_are_taken_anew_where_the_model_changed(folders, tmp_path, monkeypatch):
    monkeypatch.setenv("SCENESLAM_CACHE_DIR", str(tmp_path / "cache"))
    model = tmp_path / "model.yaml"
    words = [f"{scene}={folders}/{scene}_0" for scene in KINDS]
    for features in ("q50", "q50,q98,colour"):
        assert main(["train", str(model), *words, "--features", features]) == 0
        given = ["source=video", f"source.path={folders}/Dark_2", "run=detect_only"]
        given += ["detector=learned", f"detector.path={model}", "run.progress=false"]
        with initialize_config_module("sceneslam.conf", version_base="1.3"):
            config = resolved(compose("config", overrides=given))
        told = []
        assert detect(config, tmp_path / "run", told.append) == ()
        assert "votes: Dark 100.0 %" in told[0].splitlines()


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("Bright", "example: got 'Bright', allowed: SCENE=PATH"),
        ("=folder", "example: got '=folder'"),
        ("Bright=nothing", "film not found.*nothing"),
        ("Bright=FOLDER effects=fog", "effects/fog.*FOLDER"),
        ("Unsure=FOLDER", "example: got 'Unsure=FOLDER'"),
        ("Dusk=FOLDER", "example: got 'Dusk', the model knows: Bright, Dark"),
        ("Bright='FOLDER", "example: got .*allowed: SCENE=PATH"),
        ("Bright= ", "example: got 'Bright= ', allowed: SCENE=PATH"),
        ("Bright=FOLDER@1.2.3:8", "example: got .*allowed: SCENE=PATH"),
        ("Bright=FOLDER@7:8", "no observation of Bright has all features.*@7:8"),
    ],
)
def test_example_that_makes_no_sense_is_one_sentence(folders, model, capsys, word, told):
    path = str(folders / "Bright_0")
    assert main(["test", str(model), word.replace("FOLDER", path)]) == 2
    said = capsys.readouterr().err.replace(path, "FOLDER")
    assert re.search(told, said) and said.count("\n") == 1, said


def test_training_asks_for_two_scenes_and_known_features(folders, capsys, tmp_path):
    one = ["train", str(tmp_path / "model.yaml"), f"Bright={folders}/Bright_0"]
    assert main(one) == 2 and "two scenes" in capsys.readouterr().err
    assert main([*one, "--features", "q50,shape"]) == 2
    assert "names: got ['q50', 'shape'], allowed: different ones of q10" in capsys.readouterr().err
    assert main([*one, "--images", "0"]) == 2
    assert "--images: got 0, allowed: 1 or more" in capsys.readouterr().err


def test_a_feature_that_was_constant_in_training_decides_nothing():
    rng = np.random.default_rng(0)
    features = np.column_stack([rng.normal(size=200), np.full(200, 0.1)])
    labels = ["Bright" if value > 0 else "Dark" for value in features[:, 0]]
    model = fit(features, labels, rng.uniform(0.1, 1.0, 200), ["q50", "white"])
    scores = model.scores(np.array([[2.0, 0.1], [-2.0, 0.1], [2.0, 0.3], [-2.0, 0.3]]))
    assert [model.scenes[place] for place in scores.argmax(axis=1)] == ["Bright", "Dark"] * 2


@pytest.mark.parametrize("name", ["file/model.yaml", "."])
def test_model_that_cannot_be_written_is_named_before_a_recording_is_read(
    folders, tmp_path, capsys, monkeypatch, name
):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("sceneslam.scenes.__main__.look", None)  # reading fails
    words = [f"Bright={folders / 'bright_0'}", f"Dark={folders / 'dark_0'}"]
    assert main(["train", str(tmp_path / name), *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and str(tmp_path) in said and said.count("\n") == 1


def test_model_in_the_home_folder_is_found(model, monkeypatch):
    monkeypatch.setenv("HOME", str(model.parent))
    assert learned(Path("~") / model.name).scenes == learned(model).scenes


@pytest.mark.parametrize("text", ["[]", "scenes: [A, B]", "a: [", "\x00"])
def test_file_that_is_no_model_is_refused(tmp_path, text):
    (tmp_path / "model.yaml").write_text(text)
    with pytest.raises(InputError, match=r"model.*model\.yaml"):
        learned(tmp_path / "model.yaml")
    with pytest.raises(InputError, match="model not found"):
        learned(tmp_path / "nothing.yaml")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("weights", {"Bright": [1.0, 1.0, 1.0, 1.0], "Dark": [1.0]}),
        ("weights", {"Bright": [1.0], "Dark": [1.0]}),
        ("features", ["q50", "q75"]),
        ("scale", [0.0, 1.0, 1.0, 1.0]),
        ("bias", {"Bright": float("nan"), "Dark": 0.0}),
        ("prior", {"Bright": 1.0, "Dark": 0.0}),
        ("prior", {"Bright": 1.0}),
        ("scenes", ["Dark", "Dark"]),
    ],
)
def test_values_of_a_model_that_do_not_fit_are_refused_by_all_readers(model, tmp_path, key, value):
    node = yaml.safe_load(model.read_text()) | {key: value}
    path = tmp_path / "model.yaml"
    path.write_text(yaml.safe_dump(node))
    for read in (learned, Model.read):
        with pytest.raises(InputError, match=r"do not fit each other.*model\.yaml"):
            read(path)


def test_unknown_features_of_a_model_are_refused_with_its_file(model, tmp_path):
    node = yaml.safe_load(model.read_text()) | {"features": ["q50", "q75", "q90", "shape"]}
    (tmp_path / "model.yaml").write_text(yaml.safe_dump(node))
    with pytest.raises(InputError, match=r"features.*shape.*allowed: .*q10.*model\.yaml"):
        learned(tmp_path / "model.yaml")


def judged(probabilities, thumbnails=None):
    """Return an example of Bright with the probabilities (N, 3) that a model gave it."""
    thumbnails = [None] * len(probabilities) if thumbnails is None else thumbnails
    example = Example(scene="Bright", group="a", name="a", parts=[], config={})
    count = len(probabilities)
    seen = MeasuredExample(
        example=example,
        features=np.zeros((count, 1)),
        weights=np.ones(count),
        thumbnails=thumbnails,
    )
    scenes = ("Bright", "Dark", "Dusty")
    return Judged(seen=seen, scenes=scenes, scores=np.log(probabilities))


def test_calibration_counts_all_images_of_three_scenes():
    lines = list(table([judged([[0.4, 0.35, 0.25], [0.6, 0.3, 0.1], [0.9, 0.05, 0.05]])]))
    counts = [int(line.split()[3]) for line in lines if " to " in line]
    assert sum(counts) == 3, lines


class Mean:
    """A feature that every observation has."""

    def get_features(self, observation):
        return np.array([0.0])


def test_the_number_of_images_is_that_of_each_example(tmp_path):
    folder = write_images(tmp_path / "film", "Dark", range(100))  # 10 Hz
    rate = "source.rate_hz=10"
    for word, expected in (("@8:10", 10), ("@1:9", 10), ("", 10)):
        (seen,) = look([read_word(f"Dark='{folder}{word}' {rate}")], Mean(), 10)
        assert expected <= len(seen.features) < 2 * expected, word


def test_weights_of_a_weighted_example_add_up_to_the_gain_of_its_parts(tmp_path):
    folder = write_images(tmp_path / "film", "Dark", range(100))
    one = read_word(f"Dark={folder} source.rate_hz=10")
    parts = [Stretch(start_s=0, end_s=4, weight_per_s=0.5)]
    parts.append(Stretch(start_s=6, end_s=7, weight_per_s=3.0))
    example = replace(one, parts=parts, is_weighted=True)
    for images in (5, 40):
        (seen,) = look([example], Mean(), images)
        assert seen.weights.sum() == pytest.approx(5.0)
        assert seen.weights[-1] == pytest.approx(6.0 * seen.weights[0])


def test_sheet_shows_the_image_of_each_wrong_vote(tmp_path):
    collected = _Collected(Example(scene="Bright", group="a", name="a", parts=[], config={}))
    for grey in (None, 50, 200):
        image = None if grey is None else np.full((10, 16, 3), grey, np.uint8)
        collected.take(Observation(stamp_ns=1, image_bgr=image), 1.0, Mean())
    wrong = np.array([[0.1, 0.8, 0.1], [0.1, 0.8, 0.1], [0.2, 0.7, 0.1]])
    one = Judged(seen=collected.seen(), scenes=("Bright", "Dark", "Dusty"), scores=np.log(wrong))
    assert write_sheet([one], tmp_path / "wrong.png") == 2  # of the first there is no image
    sheet = cv2.imread(str(tmp_path / "wrong.png"))
    assert sheet[5, 5].tolist() == [50] * 3 and sheet[5, 165].tolist() == [200] * 3


def test_words_are_read_as_documented(folders):
    folder = f"{folders}/Bright_0"
    example = read_word(f"Dark:robot='{folder}@1.5:20' effects=lights_out lights=off")
    assert (example.scene, example.group) == ("Dark", "robot")
    (part,) = example.parts
    assert (part.start_s, part.end_s, part.weight_per_s) == (1.5, 20.0, 1.0)
    assert example.config["source"]["path"] == folder
    assert example.config["lights"] == "off" and example.config["effects"] is not None
    groups = {read_word(f"Dark={folder}{end}").group for end in ("/", "@0:5")}
    assert groups == {str(Path(folder).resolve())}


def test_model_that_ships_knows_rooms_and_streets(shared_data):
    """It was trained on these; that it does as well on others is measured in experiments."""
    detector = learned(None)
    footage = {
        "Bright": ["robot_light/perfect", "day_night/guoqi_normal.mp4"],
        "Dark": ["robot_light/too_dark", "day_night/guoqi_dark.mp4"],
    }
    for scene, paths in footage.items():
        for path in paths:
            seen = islice(make_source("video", shared_data / path), 3)
            assert {detector.get_scene(one).scene for one in seen} == {scene}, path
