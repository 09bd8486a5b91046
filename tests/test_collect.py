"""One table of many runs, and its page."""

from __future__ import annotations

import csv
import json
import re
from html.parser import HTMLParser

import numpy as np
import pyarrow.parquet
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from sceneslam.collect.__main__ import main
from sceneslam.collect.chart import Line, Point, draw_lines, front
from sceneslam.collect.curves import _alike, charts
from sceneslam.collect.flatten import flat
from sceneslam.collect.rows import Row, parsed, read_rows
from sceneslam.collect.status import State, Status
from sceneslam.collect.summary import groups_of, mean_of, student_t

SWITCH = {
    "confirm_delay_s": 2.0,
    "gap_s": 0.0,
    "jump_m": 0.1,
    "jump_rad": None,
    "jump_is_error": True,
    "cost_ms": 3.0,
}


def metrics(error_m, delay_s=1.0):
    return {
        "ate_rmse_m": error_m,
        "realtime_factor": 3.0,
        "switches": [SWITCH, SWITCH | {"confirm_delay_s": 1.0}],
        "detection": {"delay_s": delay_s, "false": 0, "missed": 0},
        "detector_us": {"median": 40.0},
        "notes": [],
    }


def job(folder, number, *overrides, state=State.DONE, error="", **values):
    path = folder / str(number)
    path.mkdir(parents=True)
    Status(state=state, error=error, overrides=overrides, wall_s=2.5).write(path)
    if values:
        (path / "metrics.json").write_text(json.dumps(metrics(**values)))
    return path


@pytest.fixture
def sweep(tmp_path):
    """Give a sweep of two thresholds and three seeds, of which one run died."""
    number = 0
    for threshold in (60, 100):
        for seed in (0, 1, 2):
            words = ("+scenario=flicker", f"detector.threshold={threshold}", f"seed={seed}")
            if (threshold, seed) == (100, 2):
                job(tmp_path, number, *words, state=State.KILLED, error="ended by SIGKILL")
            else:
                error_m = 0.01 * (seed + 1) * threshold / 60
                job(tmp_path, number, *words, error_m=error_m, delay_s=threshold / 60)
            number += 1
    return tmp_path


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_table_has_a_row_per_job_with_swept_keys_and_error(sweep):
    assert main([str(sweep)]) == 0
    rows = table(sweep / "table.csv")
    assert [row["job"] for row in rows] == ["0", "1", "2", "3", "4", "5"]
    assert "scenario" not in rows[0]  # the same for all
    assert (rows[4]["detector.threshold"], rows[4]["seed"]) == ("100", "1")
    assert float(rows[1]["ate_rmse_m"]) == 0.02
    assert (rows[5]["status"], rows[5]["error"]) == ("killed", "ended by SIGKILL")
    assert rows[5]["ate_rmse_m"] == ""


def test_what_the_clock_tells_is_in_a_table_of_its_own(sweep):
    main([str(sweep)])
    columns = set(table(sweep / "table.csv")[0])
    costs = {"realtime_factor", "detector_us.median", "switch_cost_ms", "job.wall_s"}
    assert not costs & columns and costs <= set(table(sweep / "costs.csv")[0])


def test_parquet_holds_the_table(sweep):
    main([str(sweep)])
    read = pyarrow.parquet.read_table(sweep / "table.parquet")
    rows = table(sweep / "table.csv")
    assert read.column_names == list(rows[0])
    errors = [row["ate_rmse_m"] for row in read.to_pylist()]
    assert errors[:5] == [float(row["ate_rmse_m"]) for row in rows[:5]] and errors[5] is None


def test_report_of_a_folder_with_signs_of_addresses_in_its_name_is_linked(sweep):
    path = job(sweep, "50 % #2", error_m=0.1)
    (path / "report.html").write_text("")
    main([str(sweep)])
    page = (sweep / "index.html").read_text()
    assert '<a href="50%20%25%20%232/report.html">50 % #2</a>' in page


def test_summary_has_means_over_seeds_with_intervals(sweep):
    main([str(sweep)])
    first, second = table(sweep / "summary.csv")
    assert (first["detector.threshold"], first["runs"], second["runs"]) == ("60", "3", "3")
    assert float(first["ate_rmse_m"]) == pytest.approx(0.02)
    assert float(first["ate_rmse_m ±"]) == pytest.approx(4.3027 * 0.01 / np.sqrt(3), rel=1e-4)


def test_summary_says_how_many_runs_a_mean_is_over(sweep):
    main([str(sweep)])
    page = (sweep / "index.html").read_text()
    first, second = table(sweep / "summary.csv")
    assert (first["ate_rmse_m runs"], second["ate_rmse_m runs"]) == ("3", "2")
    assert page.count(" (2 of 3)</td>") == 5 and "(3 of 3)" not in page


def test_run_that_was_repeated_with_its_seed_counts_once(sweep):
    words = ("+scenario=flicker", "detector.threshold=60", "seed=0")
    job(sweep, 6, *words, error_m=0.04)
    main([str(sweep)])
    first = table(sweep / "summary.csv")[0]
    assert (first["runs"], first["ate_rmse_m runs"]) == ("3", "3")
    assert float(first["ate_rmse_m"]) == pytest.approx((0.04 + 0.02 + 0.03) / 3)
    assert len(table(sweep / "table.csv")) == 7


def test_reason_that_a_run_did_not_have_counts_as_zero(tmp_path):
    counts = [{"while rgbd was lost": 9}, {}, {}]
    for seed, missing in enumerate(counts):
        path = job(tmp_path, seed, f"seed={seed}", error_m=0.1)
        told = metrics(0.1) | {"bridged": 0, "bridged_why": {}, "missing_why": missing}
        (path / "metrics.json").write_text(json.dumps(told))
    job(tmp_path, 3, "seed=3", state=State.KILLED)
    main([str(tmp_path)])
    (one,) = table(tmp_path / "summary.csv")
    name = "missing_why.while rgbd was lost"
    assert (one[name], one[f"{name} runs"]) == ("3.0", "3")


@pytest.mark.parametrize(
    ("freedom", "t"),
    [(1, 12.7062), (2, 4.3027), (3, 3.1824), (4, 2.7764), (9, 2.2622), (30, 2.0423)],
)
def test_quantiles_are_those_of_the_published_tables(freedom, t):
    assert student_t(freedom) == pytest.approx(t, abs=5e-5)


def test_interval_covers_the_true_mean_as_often_as_it_says():
    generator = np.random.default_rng(0)
    means = [mean_of(list(generator.normal(1.0, 2.0, 4))) for _ in range(2000)]
    covered = np.mean([abs(one.mean - 1.0) <= one.half_width for one in means])
    assert covered == pytest.approx(0.95, abs=0.015)


def test_switches_are_told_by_their_number_and_their_worst():
    numbers = flat(metrics(0.1))
    assert numbers["switches"] == 2
    assert (numbers["confirm_delay_s"], numbers["confirm_delay_max_s"]) == (1.5, 2.0)
    assert numbers["switch_jump_max_rad"] is None


def test_motion_of_the_pose_at_a_switch_is_no_jump():
    moved = SWITCH | {"jump_m": 0.7, "jump_rad": 0.2, "jump_is_error": False}
    numbers = flat({"switches": [SWITCH, moved]})
    assert (numbers["switch_jump_max_m"], numbers["switch_jump_max_rad"]) == (0.1, None)
    assert (numbers["switch_moved_max_m"], numbers["switch_moved_max_rad"]) == (0.7, 0.2)


def test_front_is_what_nothing_else_beats():
    points = [Point(x=x, y=y) for x, y in [(1, 5), (2, 5), (2, 3), (3, 4), (4, 0), (5, 0)]]
    assert [(point.x, point.y) for point in front(points)] == [(1, 5), (2, 3), (4, 0)]


def test_run_of_hydras_own_launcher_is_read_too(tmp_path):
    for number in (0, 1):
        (tmp_path / str(number) / ".hydra").mkdir(parents=True)
        (tmp_path / str(number) / ".hydra" / "overrides.yaml").write_text(f"- seed={number}\n")
    (tmp_path / "1" / "metrics.json").write_text(json.dumps(metrics(0.5)))
    rows = read_rows(tmp_path)
    assert [(row.status, row.keys["seed"]) for row in rows] == [("failed", 0), ("done", 1)]


def test_run_outside_a_sweep_is_incomplete_where_its_results_are(tmp_path):
    lacks = {"errors": ["interrupted"], "shortfalls": ["only 3 % of the observations got a pose"]}
    figure = {"name": "drift", "value": 0.2}
    files = [
        {"metrics.json": metrics(0.1) | lacks},
        {"metrics.json": metrics(0.1) | {"errors": [], "shortfalls": []}},
        {"verdict.json": {"figures": [figure]}},
    ]
    for number, written in enumerate(files):
        (tmp_path / str(number) / ".hydra").mkdir(parents=True)
        (tmp_path / str(number) / ".hydra" / "overrides.yaml").write_text("[]")
        for name, content in written.items():
            (tmp_path / str(number) / name).write_text(json.dumps(content))
    rows = read_rows(tmp_path)
    assert [row.status for row in rows] == ["incomplete", "done", "done"]
    assert rows[0].error == "interrupted; only 3 % of the observations got a pose"
    assert rows[2].metrics["drift"] == 0.2


@pytest.mark.parametrize(
    "text", ["010", "1:30", "0x1F", "1e-3", "-2.5E+3", ".5", "1_000", "7", "-0", "1.", "a.5", "e5"]
)
def test_swept_value_is_the_one_that_hydra_read(text):
    key, value = parsed(f"+story.key={text}")
    assert key == "story.key"
    read = OverridesParser.create().parse_override(f"a={text}").value()
    assert value == read and type(value) is type(read)


def test_numbers_of_a_run_that_was_stopped_half_way_are_left_out(tmp_path):
    job(tmp_path, 0, "seed=0", state=State.STOPPED, error="stopped while it ran", error_m=0.3)
    (row,) = read_rows(tmp_path)
    assert not row.metrics and row.status == "stopped"


def test_folder_without_a_run_is_named(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert f"no run in the folder: {tmp_path}" in capsys.readouterr().err


class Page(HTMLParser):
    """Counts tags, and refuses anything from elsewhere."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.links = {}, []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags[tag] = self.tags.get(tag, 0) + 1
        values = dict(attrs)
        self.links += [values[name] for name in ("href", "src") if name in values]


def test_page_opens_alone_and_links_into_the_reports(sweep):
    (sweep / "3" / "report.html").write_text("report")
    main([str(sweep)])
    text = (sweep / "index.html").read_text()
    page = Page(text)
    assert page.links == ["3/report.html"] and "http" not in text
    assert page.tags["svg"] >= 2 and page.tags["table"] == 2
    assert text.count("<tr>") == 2 + 2 + 6
    assert "ended by SIGKILL" in text


def test_page_escapes_what_it_is_given(tmp_path):
    for number, value in enumerate(("<script>", "b")):
        job(tmp_path, number, f"story={value}", error_m=0.1)
    main([str(tmp_path)])
    text = (tmp_path / "index.html").read_text()
    assert "&lt;script&gt;" in text and text.count("<script>") == 1


def test_long_numbers_leave_room_for_the_name_of_their_axis():
    points = [Point(x=80.0, y=0.0012), Point(x=90.0, y=0.0038)]
    drawn = draw_lines([Line(name="one", color="red", points=points)], x_label="x", y_label="y")
    ends_at = float(re.search(r'<text x="([\d.]+)" [^>]*>0.001</text>', drawn)[1])
    assert ends_at - 9 * len("0.001") >= 20  # a digit is about 9 px, the name ends at 20


def test_no_front_is_drawn_where_nothing_false_was_seen():
    metrics = [{"detection.delay_s": delay_s, "detection.false": 0.0} for delay_s in (1.0, 2.0)]
    rows = [
        Row(name=str(k), status="done", keys={"key": float(k)}, metrics=one)
        for k, one in enumerate(metrics)
    ]
    told = " ".join(charts(groups_of(rows)))
    assert "Every setting" not in told and "Detection delay" in told


def test_front_weighs_settings_over_all_recordings_where_they_ran_to_the_end():
    told = {
        ("easy", 1): (0.0, 0),
        ("hard", 1): (2.0, 4),
        ("easy", 2): (2.0, 0),
        ("hard", 2): (4, 1),
        ("easy", 3): (0.5, 0),
    }
    rows = [
        Row(
            name=f"{story}{window}",
            status="done",
            keys={"story": story, "window": window},
            metrics={"detection.delay_s": delay_s, "detection.false": false},
        )
        for (story, window), (delay_s, false) in told.items()
    ]
    rows.append(Row(name="3", status="failed", keys={"story": "hard", "window": 3}, metrics={}))
    page = " ".join(charts(groups_of(rows)))
    assert "the Pareto front: window=1: 1 s, 2 false; window=2: 3 s, 0.5 false." in page


def test_settings_that_do_alike_are_told_once_by_the_one_in_the_middle():
    twins = [Point(x=1.0, y=0.0, label=f"threshold={value}") for value in (60, 80, 100)]
    assert _alike(twins) == "threshold=80 (as 2 others): 1 s, 0 false"
