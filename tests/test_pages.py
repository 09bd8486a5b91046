"""The numbers of the pages come from files of the repository."""

from __future__ import annotations

import csv
import json
import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOOL = runpy.run_path(str(ROOT / "experiments" / "pages.py"))
PAGES = TOOL["pages"]()
DECIMAL = re.compile(r"(?<![\w.:/=-])(\d+\.\d+)(?![\w.])")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_table_is_its_file(page):
    text = page.read_text()
    assert TOOL["written_anew"](text) == text, "run: python experiments/pages.py"
    for table in TOOL["unmarked"](text):
        pytest.fail(f"of no file: {table.splitlines()[0]}; python experiments/pages.py --adopt")


def test_a_table_that_was_changed_by_hand_is_seen(tmp_path, monkeypatch):
    namespace = TOOL["_block"].__globals__
    monkeypatch.setitem(namespace, "EXPERIMENTS", tmp_path)
    page = "# A page\n\n| run | error [m] |\n|---|---|\n| one | 0.123456 |\n| two | - |\n\nEnd.\n"
    marked = TOOL["adopted"](page, "results/page")
    assert (tmp_path / "results" / "page" / "1.csv").read_text().splitlines()[1] == "one,0.123456"
    assert "<!-- results/page/1.csv -->" in marked and "| one | 0.1235 |" in marked
    assert TOOL["written_anew"](marked) == marked and not list(TOOL["unmarked"](marked))
    changed = marked.replace("0.1235", "0.1")
    assert TOOL["written_anew"](changed) == marked


def measured():
    """Return every number of the results' files."""
    found = set()
    for path in (ROOT / "experiments").rglob("*.csv"):
        with path.open(newline="") as file:
            for row in csv.reader(file):
                found |= {float(word) for cell in row for word in re.findall(r"\d+\.?\d*", cell)}
    for path in (ROOT / "experiments").rglob("verdict.json"):
        for figure in json.loads(path.read_text())["figures"]:
            found |= {abs(figure[key]) for key in ("value", "bound") if figure[key] is not None}
    return found


def test_the_numbers_of_the_overview_were_measured():
    """A decimal in its prose is that of a file, in its own unit or another, rounded."""
    text = (ROOT / "experiments" / "README.md").read_text()
    prose = TOOL["_BLOCK"].sub("", re.sub(r"```.*?```", "", text, flags=re.S))
    values = measured()
    for number in DECIMAL.findall(prose):
        half = 0.51 * 10.0 ** -len(number.partition(".")[2])
        near = (abs(value * scale - float(number)) <= half for value in values for scale in SCALES)
        assert any(near), f"{number} is in no file of experiments/"


SCALES = (1.0, 100.0, 1000.0, 0.01, 0.001)


def test_no_promise_is_looser_than_twice_what_was_measured():
    """But for times, whose bounds are the paper's, and for shares, counted from the whole."""
    for path in sorted((ROOT / "experiments").rglob("verdict.json")):
        for figure in json.loads(path.read_text())["figures"]:
            value, bound = figure["value"], figure["bound"]
            if figure["relation"] != "<=" or figure["unit"] in ("s", "ms") or not value:
                continue
            assert bound <= 2.0 * abs(value) or bound == 0.0, f"{path}: {figure['name']}"
