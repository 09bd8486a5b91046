"""What is made at the first observation is made by one at a time."""

import threading
from concurrent.futures import ThreadPoolExecutor
from time import sleep

from sceneslam.sources.made_once import MadeOnce


class Slow:
    """Counts how many are being made at once."""

    making, most = 0, 0
    guard = threading.Lock()

    def __iter__(self):
        with self.guard:
            Slow.making += 1
            Slow.most = max(Slow.most, Slow.making)
        sleep(0.02)
        with self.guard:
            Slow.making -= 1
        yield from (1, 2, 3)


def test_others_wait_until_the_first_observation_is_there(tmp_path):
    with ThreadPoolExecutor(4) as pool:
        read = list(pool.map(lambda _: list(MadeOnce(Slow(), tmp_path / "cache")), range(4)))
    assert read == [[1, 2, 3]] * 4
    assert Slow.most == 1


def test_lock_is_free_while_the_rest_is_read(tmp_path):
    first = iter(MadeOnce(Slow(), tmp_path))
    assert next(first) == 1
    assert list(MadeOnce(Slow(), tmp_path)) == [1, 2, 3]
    assert list(first) == [2, 3]
