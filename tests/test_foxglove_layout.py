"""The layout for Foxglove in a run's folder; Foxglove itself is not needed for it."""

from __future__ import annotations

import pytest

from sceneslam.modules.maps.live_map import GridAndPoints
from sceneslam.sinks.foxglove import LAYOUT, FoxgloveSink
from sceneslam.sinks.ros2.topics import TopicSink
from sceneslam.types.files import MARK, owned
from sceneslam.types.rig import Rig


@pytest.fixture
def sink(tmp_path, monkeypatch):
    monkeypatch.setattr(TopicSink, "open", lambda *_: None)
    (tmp_path / MARK).write_text("{}\n")
    mapper = GridAndPoints(resolution_m=0.1, voxel_m=0.1, depth_stride_px=8)
    return FoxgloveSink(port=0, image_every=1, jpeg_quality=50, map_every_s=1.0, mapper=mapper)


def test_a_layout_that_no_run_wrote_stays(sink, tmp_path):
    (tmp_path / LAYOUT).write_text("mine")
    with pytest.raises(FileExistsError):
        sink.open(Rig(sensors=frozenset()), tmp_path)
    assert (tmp_path / LAYOUT).read_text() == "mine"


def test_a_layout_that_an_earlier_version_wrote_is_used(sink, tmp_path):
    sink.open(Rig(sensors=frozenset()), tmp_path)
    (tmp_path / MARK).write_text("{}\n")  # which did not list it
    sink.open(Rig(sensors=frozenset()), tmp_path)


def test_a_layout_that_cannot_be_written_replaces_none(sink, tmp_path, monkeypatch):
    def fail(descriptor):
        raise OSError("no space left on device")

    sink.open(Rig(sensors=frozenset()), tmp_path)
    (tmp_path / LAYOUT).write_text(before := "another")
    assert LAYOUT in owned(tmp_path)
    monkeypatch.setattr("sceneslam.types.files.os.fsync", fail)
    with pytest.raises(OSError, match="no space left"):
        sink.open(Rig(sensors=frozenset()), tmp_path)
    assert (tmp_path / LAYOUT).read_text() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([MARK, LAYOUT])
