"""Recordings as they are played another way."""

import pytest

from sceneslam.experiments.plays import main, rows


@pytest.fixture
def recording(tmp_path):
    folder = tmp_path / "recording"
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    for name in ("rgb", "depth"):
        lines = [f"{10.0 + index:.6f} {name}/{index}.png\n" for index in range(11)]
        (folder / f"{name}.txt").write_text("# stamp file\n" + "".join(lines))
    truth = [f"{9.5 + index:.6f} {index} 0 0 0 0 0 1\n" for index in range(12)]
    (folder / "groundtruth.txt").write_text("".join(truth))
    return folder


def test_back_again_is_without_seconds_and_ends_where_it_began(recording, tmp_path):
    main(str(recording), str(tmp_path / "out"), "back_again", "0.5", "2.0")
    played = [int(rest.strip()[4:-4]) for _, rest in rows(tmp_path / "out/rgb.txt")]
    assert played == [0, 1, 2, 3, 4, 7, 8, 9, 10, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0]
    stamps_s = [stamp_s for stamp_s, _ in rows(tmp_path / "out/groundtruth.txt")]
    assert stamps_s == sorted(stamps_s) and len(stamps_s) == 18
    assert (tmp_path / "out/rgb").resolve() == (recording / "rgb").resolve()


def test_backwards_begins_with_the_last_image(recording, tmp_path):
    main(str(recording), str(tmp_path / "out"), "backwards")
    assert [rest.strip() for _, rest in rows(tmp_path / "out/rgb.txt")][:2] == [
        "rgb/10.png",
        "rgb/9.png",
    ]
    with pytest.raises(SystemExit, match="back_again"):
        main(str(recording), str(tmp_path / "other"), "sideways")
