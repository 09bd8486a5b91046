"""A message arrives whole or not at all."""

import socket

import numpy as np
import pytest

from sceneslam.supervision import transport
from sceneslam.supervision.transport import Channel


@pytest.fixture
def ends():
    near, far = map(Channel, socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET))
    yield near, far
    near.close()
    far.close()


def picture(grey):
    return np.full((240, 320, 3), grey, np.uint8)


def interrupted(*parts, strict):
    raise KeyboardInterrupt


def give_up(near, monkeypatch):
    """Announce a message, and be interrupted before its arrays are written."""
    with monkeypatch.context() as patch:
        patch.setattr(transport, "zip", interrupted, raising=False)
        with pytest.raises(KeyboardInterrupt):
            near.send(picture(1))


def test_a_message_that_was_given_up_while_it_was_written_does_not_arrive(ends, monkeypatch):
    near, far = ends
    give_up(near, monkeypatch)
    near.send(picture(2))
    np.testing.assert_array_equal(far.receive(1.0), picture(2))
    with pytest.raises(TimeoutError):
        far.receive(0.0)


def test_its_memory_is_used_again(ends, monkeypatch):
    near, far = ends
    for grey in range(5):
        give_up(near, monkeypatch)
        near.send(picture(grey))
        np.testing.assert_array_equal(far.receive(1.0), picture(grey))
        far.send("seen")
        assert near.receive(1.0) == "seen"
    assert len(near._blocks) <= 3


def test_an_end_that_hangs_up_while_it_writes_has_sent_nothing(ends, monkeypatch):
    near, far = ends
    give_up(near, monkeypatch)
    near.close()
    with pytest.raises(EOFError):
        far.receive(1.0)
