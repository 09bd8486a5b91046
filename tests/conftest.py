"""Fixtures that all tests share."""

import logging
import os
import signal
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `python -m sceneslam` sets it

import hypothesis
import pytest

from sceneslam import leaving
from sceneslam.ros.writer import ObservationWriter
from sceneslam.testing.room import RIG, room_observation

# A busy machine is slow; that is no failure of what is tested.
hypothesis.settings.register_profile("no_deadline", deadline=None)
hypothesis.settings.load_profile("no_deadline")

_SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(autouse=True)
def own_logging() -> Iterator[None]:
    """Close the log that a run inside the test's process opened: its folder is deleted after it."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    for handler in set(root.handlers) - set(handlers):
        handler.close()
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.fixture(autouse=True, scope="session")
def own_end() -> Iterator[None]:
    """Let no command that ran inside the tests' process end that with its own exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(leaving, "_watch", lambda *_: None)
        yield


@pytest.fixture
def heeds_ctrl_c() -> Iterator[None]:
    """Let Ctrl-C interrupt the test; a shell's background process ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def shared_data() -> Path:
    """Give the folder of real recordings; skip where it is absent."""
    if not _SHARED_DATA.is_dir():
        pytest.skip("the real recordings (../shared/data) are not on this machine")
    return _SHARED_DATA


@pytest.fixture(scope="session")
def recording(tmp_path_factory) -> Path:
    """Give a recording of a second in a small room, with every sensor on board."""
    path = tmp_path_factory.mktemp("recording") / "room.mcap"
    writer = ObservationWriter(path, rig=RIG, image_format="png")
    for index in range(30):
        writer.write(room_observation(index))
    writer.close()
    return path


@pytest.fixture
def folder(tmp_path, recording) -> Path:
    """Give a folder that holds `room.mcap`."""
    (tmp_path / "room.mcap").symlink_to(recording)
    return tmp_path
