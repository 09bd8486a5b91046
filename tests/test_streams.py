"""Standard output and error that are closed, hung up on or full: they cost their text alone."""

import subprocess
import sys

import pytest

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
