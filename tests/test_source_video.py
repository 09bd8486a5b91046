"""Films and folders of images, as footage to try detectors on."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from ros_recordings import make_source

from sceneslam.interfaces import Source
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.rig import Sensor

SIZE_WH = (64, 48)
GREYS = (200, 180, 160, 40, 20, 10)  # one per frame


def picture(grey: int, size_wh: tuple[int, int] = SIZE_WH) -> np.ndarray:
    return np.full((size_wh[1], size_wh[0], 3), grey, np.uint8)


@pytest.fixture
def film(tmp_path: Path) -> Path:
    path = tmp_path / "clip.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, SIZE_WH)
    for grey in GREYS:
        writer.write(picture(grey))
    writer.release()
    return path


@pytest.fixture
def images(tmp_path: Path) -> Path:
    folder = tmp_path / "images"
    folder.mkdir()
    for index, grey in enumerate(GREYS):
        cv2.imwrite(str(folder / f"{index:03d}.png"), picture(grey))
    (folder / "notes.txt").write_text("not an image")
    return folder


@pytest.mark.parametrize("kind", ["film", "images"])
def test_every_frame_is_an_observation_in_its_order(request, kind) -> None:
    source = make_source("video", request.getfixturevalue(kind), rate_hz=10.0)
    assert isinstance(source, Source) and source.rig.sensors == {Sensor.IMAGE}
    found = list(source)
    assert len(found) == source.length == len(GREYS) and source.faults == []
    greys = [one.image_bgr.mean() for one in found]
    assert np.allclose(greys, GREYS, atol=6)  # the film is compressed
    assert [one.stamp_ns for one in found] == [k * 100_000_000 for k in range(6)]
    assert [one.stamp_ns for one in source] == [one.stamp_ns for one in found]  # begins anew
    assert source.span.end_ns == found[-1].stamp_ns
    assert not found[0].image_bgr.flags.writeable


def test_stamps_are_those_of_the_film(film) -> None:
    stamps_ns = np.array([one.stamp_ns for one in make_source("video", film)])
    assert np.allclose(stamps_ns, np.arange(6) * 1e8, atol=1e6)


def test_stills_of_different_sizes_are_read_where_no_camera_is_given(images) -> None:
    cv2.imwrite(str(images / "900.png"), picture(90, (30, 20)))
    assert len(list(make_source("video", images))) == 7
    camera = {"fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0}
    source = make_source("video", images, camera=camera)
    assert source.rig.camera.size_wh == SIZE_WH
    with pytest.raises(InputError, match=r"expected 64x48 as the first image, got 30x20.*900"):
        list(source)


@pytest.mark.parametrize(
    "names",
    [
        ["0.png", "1.png", "2.png", "10.png"],
        ["left_9.PNG", "left_010.PNG", "left_11.PNG", "right_1.PNG"],
        ["9.5.png", "10.125.png", "10.2.png", "10.25.png"],  # seconds
    ],
)
def test_images_come_by_the_numbers_in_their_names(tmp_path, names) -> None:
    for number, name in enumerate(names):
        cv2.imwrite(str(tmp_path / name), picture(50 * number))
        (tmp_path / f"._{name}").write_bytes(b"of macOS")
    source = make_source("video", tmp_path)
    assert [one.image_bgr[0, 0, 0] for one in source] == [0, 50, 100, 150]
    assert source.faults == []


def test_damaged_image_is_left_out_and_reported(images) -> None:
    data = (images / "002.png").read_bytes()
    (images / "002.png").write_bytes(data[: len(data) // 2])
    source = make_source("video", images, rate_hz=10.0)
    assert [one.stamp_ns // 10**8 for one in source] == [0, 1, 3, 4, 5]
    assert len(source.faults) == 1 and "002.png" in source.faults[0]


def test_film_that_was_cut_off_gives_what_it_holds_or_says_why_not(film, tmp_path) -> None:
    data = film.read_bytes()
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(data[: len(data) // 2])  # an MP4 keeps its index at the end
    with pytest.raises(InputError, match=r"FFmpeg can read.*cut\.mp4"):
        make_source("video", cut)


def test_true_scenes_are_those_that_were_given(images) -> None:
    truth = make_source("video", images, scenes=[[0.0, "Bright"], [0.1, "Dark"]]).ground_truth()
    assert [(one.stamp_ns, one.scene) for one in truth.scenes] == [(0, "Bright"), (10**8, "Dark")]
    assert make_source("video", images).ground_truth() is None


@pytest.mark.parametrize(
    "scenes", [[[1.0, "Bright"]], [[0.0]], [["Bright", 0.0]], [[0.0, "A"], [2.0, "B"], [1.0, "A"]]]
)
def test_true_scenes_that_make_no_sense_are_refused(images, scenes) -> None:
    with pytest.raises(ConfigError, match="scenes: got"):
        make_source("video", images, scenes=scenes)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0])
def test_rate_that_makes_no_sense_is_refused(images, rate_hz) -> None:
    with pytest.raises(ConfigError, match="rate_hz"):
        make_source("video", images, rate_hz=rate_hz)


def test_home_folder_is_found(film, monkeypatch) -> None:
    monkeypatch.setenv("HOME", str(film.parent))
    assert make_source("video", "~/clip.mp4").length == len(GREYS)


def test_name_of_a_film_may_hold_a_colon(film, monkeypatch) -> None:
    film.rename(film.with_name("10:30.mp4"))
    monkeypatch.chdir(film.parent)
    assert make_source("video", "10:30.mp4").length == len(GREYS)


def test_pipe_is_no_footage(images) -> None:
    os.mkfifo(images / "004.5.png")  # reading it waits for its writer
    source = make_source("video", images)
    assert len(list(source)) == len(GREYS)
    assert "image is damaged: 1 time" in source.faults[0]
    os.mkfifo(images / "pipe.mp4")
    with pytest.raises(InputError, match=r"got a pipe or a device: .*pipe\.mp4"):
        make_source("video", images / "pipe.mp4")


def test_path_without_footage_is_one_sentence(tmp_path) -> None:
    with pytest.raises(InputError, match="film not found"):
        make_source("video", tmp_path / "nothing.mp4")
    with pytest.raises(InputError, match="a path is empty"):
        make_source("video", "")
    with pytest.raises(InputError, match="holds no images"):
        make_source("video", tmp_path)
    (tmp_path / "words.mp4").write_text("words")
    with pytest.raises(InputError, match="FFmpeg can read"):
        make_source("video", tmp_path / "words.mp4")
    (tmp_path / "empty.png").write_bytes(b"")
    with pytest.raises(InputError, match="no frame of it can be read"):
        make_source("video", tmp_path / "empty.png")
