"""A story is rendered once, by one process at a time; other stories do not wait for it."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from sceneslam.sources.simulator.cache import Cache, code_digest


def test_others_wait_for_the_same_story(tmp_path: Path) -> None:
    made = []

    def make(path: Path) -> None:
        made.append(path)
        path.write_bytes(b"rendered")

    with ThreadPoolExecutor(4) as pool:
        paths = list(pool.map(lambda _: Cache(tmp_path).fetch("a", {}, make), range(8)))
    assert len(made) == 1
    assert {path.read_bytes() for path in paths} == {b"rendered"}


def test_nobody_waits_for_another_story(tmp_path: Path) -> None:
    both = threading.Barrier(2, timeout=10.0)  # passed only where both are made at once

    def make(path: Path) -> None:
        both.wait()
        path.write_bytes(b"rendered")

    with ThreadPoolExecutor(2) as pool:
        paths = list(pool.map(lambda name: Cache(tmp_path).fetch(name, {}, make), ("a", "b")))
    assert len(set(paths)) == 2


def test_words_about_the_code_make_no_story_anew_but_its_code_does(tmp_path: Path) -> None:
    file = tmp_path / "code.py"
    file.write_text('"""Text."""\nclass A:\n    x = 1\n')
    before = code_digest(file)
    file.write_text('"""Other text."""\n# why\nclass A:\n    """Text."""\n\n    x = 1\n')
    assert code_digest(file) == before
    file.write_text("class A:\n    x = 2\n")
    assert code_digest(file) != before
