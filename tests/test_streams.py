"""Standard output and error that are closed, hung up on or full: they cost their text alone."""

import json
import subprocess
import sys

import pytest

from sceneslam.storage.folder import RunFolder

WRITE = """
import os, sys
from sceneslam.streams import lost_output, secure_streams
secure_streams()
for number in range(2000):
    print("out", number)
    print("err", number, file=sys.stderr)
os.write(1, b"")  # as native code does
os.write(2, b"native\\n")
file = os.open(sys.argv[1], os.O_CREAT | os.O_WRONLY)
os.write(file, b"whole" if file > 2 else b"it is a stream")
sys.exit(7)
"""


@pytest.mark.parametrize(
    "streams",
    [
        ">/dev/null",
        ">&-",
        "2>&-",
        "<&- >&- 2>&-",
        ">/dev/full 2>/dev/full",
        "| head -c 10 >/dev/null",
        "2> >(head -c 120 >/dev/null)",
        "2> >(exec 0<&-)",
    ],
)
def test_streams_change_neither_result_nor_exit_code(tmp_path, streams):
    script = f'"$0" -c "$1" "$2" {streams}; exit ${{PIPESTATUS[0]}}'
    words = ["bash", "-c", script, sys.executable, WRITE, str(tmp_path / "result")]
    assert subprocess.run(words, capture_output=True, check=False).returncode == 7
    assert (tmp_path / "result").read_text() == "whole"


def test_what_a_terminal_cannot_show_is_no_error():
    words = [sys.executable, "-c", "from sceneslam.streams import *\nsecure_streams()\nprint('–')"]
    done = subprocess.run(words, capture_output=True, env={"PYTHONIOENCODING": "ascii"}, check=True)
    assert done.stdout == b"\\u2013\n"


def test_a_sweep_is_continued_without_a_reader(tmp_path):
    RunFolder.claim(tmp_path, kind="sweep").close()
    (tmp_path / ".sweep").mkdir()
    kept = {"launcher": {"backend": "basic"}, "began_in": str(tmp_path), "jobs": ["0"]}
    (tmp_path / ".sweep" / "sweep.json").write_text(json.dumps(kept))
    (tmp_path / "0").mkdir()
    (tmp_path / "0" / "job.json").write_text('{"state": "waiting"}')
    script = '"$0" -m sceneslam.sweep "$1" >&- 2>/dev/full'
    words = ["bash", "-c", script, sys.executable, str(tmp_path)]
    assert subprocess.run(words, check=False).returncode == 1
    assert (tmp_path / "table.csv").is_file()


@pytest.mark.parametrize("name", ["collect", "decisions", "evaluation", "scenes", "sweep"])
def test_a_program_that_cannot_say_what_is_wrong_ends_as_usual(tmp_path, name):
    arguments = {"evaluation": ["ate", "no", "no"], "scenes": ["label", "new", "no", "no"]}
    said = [sys.executable, "-m", f"sceneslam.{name}", *arguments.get(name, ["no"])]
    words = ["bash", "-c", '"$0" "$@" >/dev/full 2>/dev/full', *said]
    assert subprocess.run(words, cwd=tmp_path, check=False).returncode == 2
