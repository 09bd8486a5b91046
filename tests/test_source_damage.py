"""Damaged recordings: what is whole is read, the rest is said in a sentence."""

import re
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from ros_recordings import STAMP_NS, make_source

from sceneslam.ros.encode import Encoder
from sceneslam.ros.messages import MessageDecoder, TopicType
from sceneslam.ros.writer import ObservationWriter
from sceneslam.sources.rosbag import RosBag
from sceneslam.types.errors import InputError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor

COUNT = 60


def record(path: Path, *, counts: bool = True) -> None:
    """Write frames of noise: about 45 kB each, several to a chunk."""
    rng = np.random.default_rng(1)
    camera = Camera(size_wh=(160, 90), fx=100, fy=100, cx=80, cy=45)
    rig = Rig(sensors=frozenset({Sensor.IMAGE}), camera=camera)
    writer = ObservationWriter(path, rig=rig, image_format="png")
    for index in range(COUNT):
        image = rng.integers(0, 256, (90, 160, 3), dtype=np.uint8)
        writer.write(Observation(stamp_ns=STAMP_NS + index * 10**8, image_bgr=image))
    if not counts:
        writer._mcap._Writer__statistics.channel_message_counts.clear()
    writer.close()


def read(path: Path) -> tuple[RosBag, list[Observation]]:
    source = make_source("mcap", path)
    return source, list(source)


@pytest.mark.parametrize("share", [0.3, 0.7, 0.97])
def test_a_cut_off_mcap_gives_what_is_whole(tmp_path: Path, share: float) -> None:
    record(tmp_path / "whole.mcap")
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(len(data) * share)])
    source, found = read(tmp_path / "cut.mcap")
    assert COUNT * share - 8 <= len(found) <= COUNT * share
    (fault,) = source.faults
    count = int(re.search(r"/ (\d+) messages", fault)[1])  # an image and its camera_info
    assert count in (2 * len(found) + 1, 2 * len(found) + 2)
    assert f"cut off after {0.1 * (count // 2 - 1):.1f} s / " in fault
    assert "the rest of the recording is missing and could not be read" in fault
    assert "%" not in fault
    assert str(tmp_path / "cut.mcap") in fault


def test_a_summary_without_counts_by_channel_is_whole(tmp_path: Path) -> None:
    record(tmp_path / "whole.mcap", counts=False)
    source, found = read(tmp_path / "whole.mcap")
    assert len(found) == source.length == COUNT
    assert source.faults == []


def test_a_missing_index_alone_loses_nothing(tmp_path: Path) -> None:
    record(tmp_path / "whole.mcap")
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[:-9])
    source, found = read(tmp_path / "cut.mcap")
    assert len(found) == COUNT
    (fault,) = source.faults
    assert "its index is damaged (read without it)" in fault


@pytest.mark.parametrize("from_end", [9, 20, 200])
def test_a_flipped_bit_in_the_index_loses_nothing_and_is_told(
    tmp_path: Path, from_end: int
) -> None:
    record(tmp_path / "flipped.mcap")
    data = bytearray((tmp_path / "flipped.mcap").read_bytes())
    data[-from_end] ^= 4
    (tmp_path / "flipped.mcap").write_bytes(data)
    source, found = read(tmp_path / "flipped.mcap")
    assert len(found) == COUNT
    (fault,) = source.faults
    assert "its index is damaged (read without it)" in fault


def test_a_file_that_was_written_without_an_index_is_sound(tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap.writer import IndexType, Writer

    record(tmp_path / "whole.mcap")
    with (tmp_path / "whole.mcap").open("rb") as old, (tmp_path / "bare.mcap").open("wb") as new:
        writer = Writer(
            new,
            index_types=IndexType.NONE,
            use_statistics=False,
            use_summary_offsets=False,
            repeat_channels=False,
            repeat_schemas=False,
        )
        writer.start(profile="ros2", library="test")
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(old).iter_messages():
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(channels[channel.topic], message.log_time, message.data, 0)
        writer.finish()
    source, found = read(tmp_path / "bare.mcap")
    assert len(found) == COUNT
    assert list(source.faults) == []


def test_damage_in_a_file_that_is_cut_off_is_told_as_well(tmp_path: Path) -> None:
    record(tmp_path / "whole.mcap")
    data = bytearray((tmp_path / "whole.mcap").read_bytes())
    data[len(data) // 3] ^= 4
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    source, found = read(tmp_path / "cut.mcap")
    assert len(found) < COUNT * 2 / 3 - 2
    (fault,) = source.faults
    assert "cut off" in fault
    assert "% of the file" in fault


def test_a_flipped_bit_costs_its_chunk_and_is_told(tmp_path: Path) -> None:
    record(tmp_path / "flipped.mcap")
    data = bytearray((tmp_path / "flipped.mcap").read_bytes())
    data[len(data) // 2] ^= 4
    (tmp_path / "flipped.mcap").write_bytes(data)
    source, found = read(tmp_path / "flipped.mcap")
    assert COUNT - 8 <= len(found) < COUNT
    (fault,) = source.faults
    assert "damaged" in fault


def test_no_place_for_a_flipped_bit_makes_wrong_pixels_or_a_crash(tmp_path: Path) -> None:
    record(tmp_path / "whole.mcap")
    path = tmp_path / "flipped.mcap"
    data = (tmp_path / "whole.mcap").read_bytes()
    good = {one.stamp_ns: one.image_bgr.tobytes() for one in read(tmp_path / "whole.mcap")[1]}
    for place in np.random.default_rng(5).integers(8, len(data), 25).tolist():
        flipped = bytearray(data)
        flipped[place] ^= 1 << (place % 8)
        path.write_bytes(flipped)
        for observation in read(path)[1]:
            assert observation.image_bgr.tobytes() == good[observation.stamp_ns]


def test_a_damaged_record_outside_of_chunks_is_left_out_and_told(tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap.writer import Writer

    record(tmp_path / "whole.mcap")
    with (tmp_path / "whole.mcap").open("rb") as old, (tmp_path / "flat.mcap").open("wb") as new:
        writer = Writer(new, use_chunking=False)
        writer.start(profile="ros2", library="test")
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(old).iter_messages():
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(channels[channel.topic], message.log_time, message.data, 0)
        writer.finish()
    assert len(read(tmp_path / "flat.mcap")[1]) == COUNT
    data = bytearray((tmp_path / "flat.mcap").read_bytes())
    data[data.index(b"sensor_msgs/msg/CameraInfo")] = 0xA1  # no UTF-8
    (tmp_path / "flat.mcap").write_bytes(data)
    source, found = read(tmp_path / "flat.mcap")
    assert len(found) == COUNT
    (fault,) = source.faults
    assert "is damaged and could not be read" in fault


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("empty.mcap", b"", "empty"),
        ("empty.bag", b"", "empty"),
        ("text.mcap", b"this is no recording at all", "expected a ROS 1 bag"),
        ("only_magic.mcap", b"\x89MCAP0\r\n", "no readable messages at all; cut off"),
        ("only_magic.bag", b"#ROSBAG V2.0\n", "no readable messages"),
        ("one.db3", b"SQLite format 3\0" + b"x" * 50, "rosbag2 folder"),
    ],
)
def test_what_is_no_recording_is_one_sentence(
    tmp_path: Path, name: str, data: bytes, says: str
) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=says) as caught:
        make_source("rosbag", tmp_path / name)
    assert str(caught.value).endswith(str(tmp_path / name))


def test_a_missing_path_and_an_empty_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"not found: .*nowhere\.mcap"):
        make_source("mcap", tmp_path / "nowhere.mcap")
    with pytest.raises(InputError, match="neither metadata"):
        make_source("rosbag", tmp_path)


def test_hidden_files_in_a_folder_are_no_recordings(tmp_path: Path) -> None:
    record(tmp_path / "bag_0.mcap")
    (tmp_path / "._bag_0.mcap").write_bytes(b"of macOS")
    source, found = read(tmp_path)
    assert len(found) == COUNT and source.faults == []


def test_a_bag_with_a_damaged_index_is_read_without_it(shared_data: Path) -> None:
    source = make_source("rosbag", shared_data / "bags" / "broken_index.bag")
    assert len(list(source)) == source.length == 360
    (fault,) = source.faults
    assert "its index is damaged (read without it)" in fault
    assert "cut off" not in fault


@pytest.mark.parametrize("share", [0.4, 0.8, 0.99])
def test_a_cut_off_bag_gives_what_is_whole(shared_data: Path, tmp_path: Path, share: float) -> None:
    data = (shared_data / "bags" / "hokuyo_scan.bag").read_bytes()
    (tmp_path / "cut.bag").write_bytes(data[: int(len(data) * share)])
    source = make_source("rosbag", tmp_path / "cut.bag")
    found = list(source)
    assert 360 * share - 20 <= len(found) <= 360
    (fault,) = source.faults
    length_s = (found[-1].stamp_ns - found[0].stamp_ns) * 1e-9
    assert f"cut off after {length_s:.1f} s / {len(found)} messages" in fault
    assert f"about {100 * (1 - share):.0f} % of the recording is missing" in fault


def test_a_bag_that_lost_its_index_alone_lost_no_message(shared_data: Path, tmp_path: Path) -> None:
    data = (shared_data / "bags" / "hokuyo_scan.bag").read_bytes()
    (tmp_path / "cut.bag").write_bytes(data[:-100])
    source = make_source("rosbag", tmp_path / "cut.bag")
    assert len(list(source)) == 360
    (fault,) = source.faults
    assert fault.startswith("its index is damaged (read without it): ")


@pytest.mark.parametrize("from_end", [5, 60])
def test_a_flipped_bit_in_the_index_of_a_bag_loses_nothing_and_is_told(
    shared_data: Path, tmp_path: Path, from_end: int
) -> None:
    data = bytearray((shared_data / "bags" / "hokuyo_scan.bag").read_bytes())
    data[-from_end] ^= 16
    (tmp_path / "flipped.bag").write_bytes(data)
    source = make_source("rosbag", tmp_path / "flipped.bag")
    assert len(list(source)) == 360
    (fault,) = source.faults
    assert "its index is damaged (read without it)" in fault


def test_a_damaged_sqlite_bag_is_one_sentence(shared_data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    for file in (shared_data / "bags" / "hokuyo_scan_db3").iterdir():
        data = file.read_bytes()
        (folder / file.name).write_bytes(data[: len(data) // 3] if file.suffix == ".db3" else data)
    with pytest.raises(InputError, match="cannot be read"):
        list(make_source("rosbag", folder))


def test_an_sqlite_folder_without_metadata_says_how_to_get_it(
    shared_data: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "drive 1"
    copytree(shared_data / "bags" / "hokuyo_scan_db3", folder)
    (folder / "metadata.yaml").unlink()
    with pytest.raises(InputError, match=rf"`ros2 bag reindex '{folder}' -s sqlite3`"):
        make_source("rosbag", folder)


@pytest.mark.parametrize("odd", ["#", "?", "%20"])
def test_a_character_that_no_path_of_an_sqlite_bag_may_have_is_named(
    shared_data: Path, tmp_path: Path, odd: str
) -> None:
    copytree(shared_data / "bags" / "hokuyo_scan_db3", tmp_path / f"run{odd}1")
    with pytest.raises(InputError, match=re.escape(f"no SQLite file with '{odd}' in its path")):
        make_source("rosbag", tmp_path / f"run{odd}1")


def test_a_definition_in_idl_may_be_of_several_files() -> None:
    own = "module own { module msg { struct Named { std_msgs::msg::String name; }; }; };"
    of_string = "module std_msgs { module msg { struct String { string data; }; }; };"
    head = "=" * 80 + "\nIDL: {}\n"
    kind = TopicType(
        msgtype="own/msg/Named",
        encoding="cdr",
        definition=head.format("own/msg/Named")
        + own
        + "\n"
        + head.format("std_msgs/msg/String")
        + of_string,
        definition_format="ros2idl",
        count=1,
    )
    data = Encoder().text("laser")
    message = MessageDecoder({"/named": kind}).decode("/named", data)
    assert message.name.data == "laser"
