"""Folders in the layout of the TUM RGB-D benchmark."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from ros_recordings import make_source

from sceneslam.interfaces import Source
from sceneslam.sources.contract.ordered import Ordered
from sceneslam.sources.survey.preflight import preflight
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.rig import Sensor, optical_to_rep103

CAMERA = {"fx": 40.0, "fy": 41.0, "cx": 20.0, "cy": 15.0}
COLOR = np.full((30, 40, 3), 90, np.uint8)
DEPTH = np.full((30, 40), 10000, np.uint16)


def make_folder(
    path: Path,
    count: int = 4,
    depth_delay_s: float = 0.005,
    size_wh: tuple[int, int] = (40, 30),
) -> Path:
    """Write a folder of `count` frames at 10 Hz."""
    for name in ("rgb", "depth"):
        (path / name).mkdir(parents=True)
    colors, depths = ["# timestamp filename"], ["# timestamp filename"]
    for index in range(count):
        cv2.imwrite(str(path / "rgb" / f"{index}.png"), cv2.resize(COLOR, size_wh))
        cv2.imwrite(str(path / "depth" / f"{index}.png"), cv2.resize(DEPTH, size_wh))
        colors.append(f"{100 + index * 0.1:.6f} rgb/{index}.png")
        depths.append(f"{100 + index * 0.1 + depth_delay_s:.6f} depth/{index}.png")
    (path / "rgb.txt").write_text("\n".join(colors))
    (path / "depth.txt").write_text("\n".join(depths))
    (path / "groundtruth.txt").write_text("100.0 1 2 3 0 0 0 1\n")
    return path


def make(path: Path, **changes: Any) -> Any:
    return make_source("tum_rgbd", path, **{"camera": CAMERA, **changes})


def test_every_colour_frame_is_an_observation(shared_data: Path) -> None:
    source = make_source("tum_rgbd", shared_data / "tum_fr1_rpy")
    assert isinstance(source, Source)
    found = list(source)
    assert len(found) == source.length == 400
    assert sum(one.has(Sensor.DEPTH) for one in found) >= 380
    assert source.faults == []
    assert source.rig.camera.cy == 255.3
    assert len(source.ground_truth().trajectory) == 1738


def test_stamps_keep_their_microseconds(shared_data: Path) -> None:
    first = next(iter(make_source("tum_rgbd", shared_data / "tum_fr1_rpy")))
    assert first.stamp_ns == 1305031229_528748_000
    assert first.depth_m.dtype == np.float32
    assert not first.depth_m.flags.writeable


def test_images_of_an_unsorted_list_come_by_their_stamps(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a")
    lines = (folder / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join(lines[::-1]))
    found = list(Ordered(make(folder)))
    assert [one.stamp_ns // 10**8 for one in found] == [1000, 1001, 1002, 1003]
    assert all(one.has(Sensor.DEPTH) for one in found)


def test_depth_is_metres_and_cut_to_its_range(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a")
    (first, *_) = make(folder)
    np.testing.assert_array_equal(first.depth_m, np.full((30, 40), 2.0, np.float32))
    (first, *_) = make(folder, depth_range_m=[0.3, 1.5])
    assert not first.depth_m.any()


@pytest.mark.parametrize("range_m", [[0.3, float("inf")], [2.0, 1.0], [0.3], "far"])
def test_a_range_of_depth_has_two_ends(tmp_path: Path, range_m: object) -> None:
    with pytest.raises(ConfigError) as caught:
        make(make_folder(tmp_path / "a"), depth_range_m=range_m)
    assert caught.value.key == "depth_range_m"


def test_depth_beyond_the_tolerance_is_left_out(tmp_path: Path) -> None:
    found = list(make(make_folder(tmp_path / "a", depth_delay_s=0.03)))
    assert len(found) == 4
    assert not any(one.has(Sensor.DEPTH) for one in found)


def test_truth_of_the_camera_becomes_truth_of_the_base(tmp_path: Path) -> None:
    (T_gt_base,) = make(make_folder(tmp_path / "a")).ground_truth().trajectory.T_world_base
    np.testing.assert_allclose(T_gt_base[:3, :3], optical_to_rep103()[:3, :3].T, atol=1e-12)
    np.testing.assert_allclose(T_gt_base[:3, 3], [1, 2, 3])


@pytest.mark.parametrize(("name", "fx"), [("x_freiburg2_desk", 520.9), ("fr3-office", 535.4)])
def test_the_benchmarks_cameras_are_known_and_named(tmp_path: Path, name: str, fx: float) -> None:
    source = make_source("tum_rgbd", make_folder(tmp_path / name, size_wh=(640, 480)))
    assert source.rig.camera.fx == fx
    (line, _) = preflight(source.survey(), source.rig).lines
    assert line.endswith(f"camera of {'freiburg2' if fx == 520.9 else 'freiburg3'}")


def test_the_benchmarks_cameras_have_one_size(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "freiburg1_x", size_wh=(848, 480))
    with pytest.raises(ConfigError, match=r"images of 640x480, not 848x480 pixels") as caught:
        make_source("tum_rgbd", folder)
    assert caught.value.key == "camera.fx"
    source = make(folder)
    assert "camera of" not in preflight(source.survey(), source.rig).lines[0]


def test_an_unknown_folder_asks_for_the_camera(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        make_source("tum_rgbd", make_folder(tmp_path / "kitchen"))
    assert caught.value.key == "camera.fx"


def test_a_given_camera_without_distortion_has_none(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "freiburg1_x")
    assert make(folder).rig.camera.distortion == (0.0, 0.0, 0.0, 0.0, 0.0)


def test_missing_and_damaged_images_are_passed_over_and_named(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a")
    (folder / "rgb" / "1.png").unlink()
    whole = (folder / "depth" / "2.png").read_bytes()
    (folder / "depth" / "2.png").write_bytes(whole[: len(whole) // 2])
    source = make(folder)
    found = list(source)
    assert len(found) == 4
    assert [one.has(Sensor.IMAGE) for one in found] == [True, False, True, True]
    assert [one.has(Sensor.DEPTH) for one in found] == [True, True, False, True]
    assert any("missing: 1 time" in fault and "rgb/1.png" in fault for fault in source.faults)
    assert any("damaged: 1 time" in fault and "depth/2.png" in fault for fault in source.faults)


def overwrite(folder: Path, name: str, stored: np.ndarray) -> None:
    cv2.imwrite(str(folder / name), stored)


@pytest.mark.parametrize(
    ("name", "stored", "says"),
    [
        ("depth/0.png", COLOR[..., 0], "8 bit in 1, not 16 bit in one channel"),
        ("depth/2.png", COLOR, "8 bit in 3, not 16 bit in one channel"),
        ("depth/0.png", DEPTH[::2, ::2], "20x15 pixels, not 40x30"),
        ("rgb/0.png", COLOR[::2, ::2], "20x15 pixels, not 40x30"),
    ],
)
def test_one_image_of_another_kind_is_left_out_and_named(
    tmp_path: Path, name: str, stored: np.ndarray, says: str
) -> None:
    folder = make_folder(tmp_path / "a")
    overwrite(folder, name, stored)
    source = make(folder)
    found = list(source)
    assert len(source.survey().depths_m) == (3 if "depth" in name else 4)
    assert sum(one.has(Sensor.IMAGE) + one.has(Sensor.DEPTH) for one in found) == 7
    assert source.faults == [f"image left out, it has {says}: 1 time at {folder / name}"]


@pytest.mark.parametrize(
    ("stored", "says"),
    [
        (COLOR[..., 0], r"the first has 8 bit in 1, not 16 bit in one channel: .*depth/1\.png"),
        (DEPTH[::2, ::2], r"the first has 20x15 pixels, not 40x30: .*depth/1\.png"),
    ],
)
def test_depth_that_is_all_of_another_kind_is_refused(
    tmp_path: Path, stored: np.ndarray, says: str
) -> None:
    folder = make_folder(tmp_path / "a")
    for index in (1, 2, 3):
        overwrite(folder, f"depth/{index}.png", stored)
    assert len(list(make(folder))) == 4
    (folder / "depth" / "0.png").unlink()
    with pytest.raises(InputError, match=f"depth: no image that was looked at fits, {says}"):
        make(folder)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "the list has no images"),
        ("# nothing\n", "the list has no images"),
        ("100.0\n", "line 1: expected `stamp_s name`"),
        ("100.0 rgb/0.png\nnow rgb/1.png\n", "line 2: expected"),
        ("nan rgb/0.png\n", "line 1: expected"),
        ("1403636579763555584 rgb/0.png\n", "line 1: expected `stamp_s name`"),
        ("100.0 rgb/9.png\n", "none of the colour images"),
    ],
)
def test_a_list_that_makes_no_sense_is_one_sentence(tmp_path: Path, text: str, says: str) -> None:
    folder = make_folder(tmp_path / "a")
    (folder / "rgb.txt").write_text(text)
    with pytest.raises(InputError, match=says):
        make(folder)


def test_missing_folders_and_lists_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"not found.*nowhere"):
        make(tmp_path / "nowhere")
    with pytest.raises(InputError, match="is missing"):
        make(tmp_path)


def test_colour_alone_will_do(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a")
    (folder / "depth.txt").unlink()
    source = make(folder)
    assert source.rig.sensors == {Sensor.IMAGE}
    assert len(list(source)) == 4
