"""An experiment's page: promises, pictures, runs, and how to do it again."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from sceneslam.evaluation.report.verdict_page import Asked, Ran, write_verdict_page
from sceneslam.types.experiment import Figure, Table, Trial, Verdict

ASKED = Asked(
    name="night",
    question=["What is lost at <night>?"],
    command="python -m sceneslam +experiment=night",
    config_yaml="seed: 0\n",
)
FIGURES = [Figure.at_most("kept", 0.01, 0.03, "m"), Figure.at_most("broken", 0.04, 0.03, "m")]
TABLE = Table(columns=("run", "points"), rows=[("one", 40050.0), ("two", None)])


@pytest.fixture
def page(tmp_path):
    cv2.imwrite(str(tmp_path / "seen.png"), np.zeros((4, 4), np.uint8))
    runs = []
    for name in ("lit #1", "dark"):
        trial = Trial(name=name, overrides=(f"lights={name}",), values={"seed": 3})
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        metrics = {"coverage": 1.0, "ate_rmse_m": 0.0123, "shortfalls": ["<laser> failed once"]}
        faults = ("torn",) if name == "dark" else ()
        runs.append(Ran(trial=trial, folder=folder, metrics=metrics, faults=faults))
    (runs[0].folder / "report.html").touch()
    captions = {"seen.png": "What was seen.", "never_drawn.png": "Nothing."}
    verdict = Verdict(figures=FIGURES, table=TABLE, pictures=captions)
    return write_verdict_page(tmp_path, ASKED, verdict, runs).read_text()


def test_what_fails_comes_first_with_what_was_measured_and_what_was_promised(page):
    assert "1 of 2 bounds hold" in page
    badges = re.findall(r"<b>(holds|FAILS)</b><div>(\w+)</div><span>([^<]*)</span>", page)
    assert badges == [
        ("FAILS", "broken", "0.04 m (at most 0.03)"),
        ("holds", "kept", "0.01 m (at most 0.03)"),
    ]


def test_the_page_needs_no_other_file_but_the_reports_that_it_leads_to(page):
    assert re.findall(r'src="([^"]{22})', page) == ["data:image/png;base64,"]
    assert re.findall(r'href="([^#"][^"]*)"', page) == ["runs/lit%20%231/report.html"]
    assert "Nothing." not in page and "What was seen." in page


def test_the_page_says_what_a_trial_lacks(page):
    assert "<td>&lt;laser&gt; failed once</td>" in page and "<td>2, first: torn</td>" in page


def test_the_page_tells_what_was_asked_and_how_to_ask_again(page):
    assert "What is lost at &lt;night&gt;?" in page
    assert "<pre>python -m sceneslam +experiment=night</pre>" in page and "seed: 0" in page
    assert "lights=dark seed=3" in page and "100.0 %" in page and "0.0123 m" in page
    assert "<td>40050</td>" in page and "<td>-</td>" in page
