"""The README's commands compose, its files exist, and its two main commands are the Makefile's."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def shell_lines():
    blocks = "\n".join(re.findall(r"```sh\n(.*?)```", README, re.S)).replace("\\\n", " ")
    return [line.split("#")[0].strip() for line in blocks.splitlines() if line.strip()]


@pytest.mark.parametrize("line", [line for line in shell_lines() if "-m sceneslam +" in line])
def test_command_composes(line):
    words = [sys.executable, *shlex.split(line)[1:], "--cfg", "job"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "policy:" in done.stdout


def test_main_commands_are_targets_of_the_makefile():
    assert {"make demo", "make test"} <= set(shell_lines())
    makefile = (ROOT / "Makefile").read_text()
    assert "\ndemo:" in makefile and "\ntest:" in makefile


def test_everything_linked_is_there():
    for target in re.findall(r"\]\(([^)]+)\)", README):
        if not target.startswith("http"):
            page, _, anchor = target.partition("#")
            assert (ROOT / page).exists(), target
            assert not anchor or anchor in anchors(ROOT / page), target


def anchors(page):
    """Return what the headings of a page are linked by."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.M)
    return {re.sub(r"[^\w\s-]", "", one).strip().lower().replace(" ", "-") for one in headings}


def test_every_option_is_listed():
    options = (ROOT / "docs" / "options.md").read_text()
    for group in ("scenario", "source", "effects", "detector", "slam", "experiment"):
        for path in (ROOT / "conf" / group).rglob("*.yaml"):
            name = path.relative_to(ROOT / "conf" / group).with_suffix("").as_posix()
            assert name == "none" or f"`{name}`" in options, f"{group}={name}"
