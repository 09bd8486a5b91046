import re
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from evaluation_runs import (
    PERIOD_NS,
    SETTINGS,
    START_NS,
    empty_map,
    happened,
    hybrid_map,
    loop,
    part_of,
    poseless_run,
    switched_run,
    timings,
    true_loop,
    without,
)
from matplotlib.figure import Figure

from sceneslam.evaluation.figures import style as look
from sceneslam.evaluation.figures.features import feature_limits
from sceneslam.evaluation.figures.run_figures import write_figures
from sceneslam.evaluation.figures.time import draw_timeline
from sceneslam.evaluation.metrics import evaluate
from sceneslam.evaluation.report.run_page import _numbers, write_report
from sceneslam.types.run import KeyMoment, RunResult
from sceneslam.types.truth import GroundTruth

LIMIT_BYTES = 150_000


def draw(folder, run, truth, **more):
    drawn = write_figures(
        folder,
        run,
        truth,
        threshold=100.0,
        limits={"light": [55.0]},
        association_gap_s=0.01,
        **more,
    )
    assert all(figure.png.stat().st_size < LIMIT_BYTES for figure in drawn)
    assert all(len(figure.svg) < 3 * LIMIT_BYTES for figure in drawn)
    return [figure.name for figure in drawn]


def report(folder, run, truth, **more) -> str:
    metrics = evaluate(run, truth, settings=SETTINGS, reference=more.get("reference"))
    given = {"title": "a run", "config": {}, "threshold": 100.0, "value_label": "mean of grey"}
    given |= {"config_yaml": "a: 1\n", "versions": {}, "faults": []}
    path = write_report(folder, run, truth, metrics, **{**given, **more})
    return path.read_text(encoding="utf-8")


def single_pose() -> RunResult:
    run = switched_run()
    return replace(part_of(run, slice(0, 1)), events=run.events[:4], timings=timings(1))


def test_all_figures_of_a_switched_run_are_drawn(tmp_path):
    names = draw(tmp_path, switched_run(), true_loop(), reference=loop(200))
    drawn = ["map", "view", "timeline", "grey_mean", "error", "error_path", "pose", "difference"]
    assert names == drawn


def test_a_path_that_is_small_in_the_map_is_drawn_apart(tmp_path):
    wide, run = hybrid_map(), switched_run()
    far = replace(wide.points, points=20.0 * wide.points.points)
    names = draw(tmp_path, replace(run, map=replace(wide, points=far, grid=None)), true_loop())
    assert names == ["map", "path", "view", "timeline", "grey_mean", "error", "error_path", "pose"]


def test_the_page_is_named_after_its_recording_and_says_when_no_truth_is_known(tmp_path):
    page = report(tmp_path, switched_run(), None, config={"source": {"path": "night/<1>.bag"}})
    assert "<h1>a run · &lt;1&gt;.bag</h1>" in page and "No ground truth is known" in page


def test_map_has_equal_axes(tmp_path):
    run, grid_alone = switched_run(), replace(empty_map(), grid=hybrid_map().grid)
    draw(tmp_path, replace(run, map=grid_alone), None)
    image = cv2.imread(str(tmp_path / "map.png"))
    assert image.shape[1] == 900
    walls = np.all(np.abs(image.astype(int) - 117) < 6, axis=2)  # 5 m long, 3 m apart
    rows = np.flatnonzero(walls.sum(axis=1) > 300)
    length_px = np.flatnonzero(walls[rows].sum(axis=0) > 5)
    ratio = (length_px[-1] - length_px[0]) / (rows[-1] - rows[0])
    assert ratio == pytest.approx(5.0 / 3.0, abs=0.03)


def test_trajectory_has_a_colour_per_module(tmp_path):
    draw(tmp_path, switched_run(), None)
    image = cv2.imread(str(tmp_path / "map.png"))[:, :, ::-1].astype(int)
    for color in ([0, 114, 178], [213, 94, 0]):
        assert np.count_nonzero(np.abs(image - color).max(axis=2) < 8) > 300


@pytest.mark.parametrize(
    ("share", "text", "is_named"),
    [
        (0.5, "CameraFrozen", True),
        (0.12, "Camera\nFrozen", True),
        (0.05, "Camera\nFrozen", False),
    ],
)
def test_a_stretch_of_time_is_named_as_far_as_there_is_room(share, text, is_named):
    axes = Figure(figsize=(look.WIDTH_IN, 4.0)).subplots()
    found, size = look.fitted(axes, "CameraFrozen", share)
    assert found == text and bool(size) is is_named
    assert size <= look.fitted(axes, "Dark", share)[1] or not is_named


@pytest.mark.parametrize(("dropped", "is_marked"), [(0, False), (3, True)])
def test_timeline_marks_dropped_observations_only_where_there_are_some(dropped, is_marked):
    run = switched_run()
    event = happened("dropped", int(run.observed_ns[-1]), count=dropped)
    figure = draw_timeline(replace(run, events=[*run.events, event]), None)
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert ("faults" in names) == is_marked


def test_figures_are_the_same_bytes_each_time(tmp_path):
    draw(tmp_path / "a", switched_run(), true_loop())
    draw(tmp_path / "b", switched_run(), true_loop())
    for first in (tmp_path / "a").iterdir():
        assert first.read_bytes() == (tmp_path / "b" / first.name).read_bytes()


def test_what_rules_measure_is_drawn_with_their_limits(tmp_path):
    run = switched_run()
    measured = {"features": {"light": 50.0, "other": 1.0}}
    events = [event | (measured if event["event"] == "vote" else {}) for event in run.events]
    names = draw(tmp_path, replace(run, events=events), None)
    assert "features" in names


def test_limits_of_rules_are_read_with_their_named_values():
    rules = {"dark": {"when": {"grey_mean": [None, "dim"]}}, "plain": None}
    rules["half"] = {"when": {"grey_mean": ["dim", 90.0]}}
    assert feature_limits({"values": {"dim": 55.0}, "rules": rules}) == {"grey_mean": [55.0, 90.0]}


def test_figures_without_truth_leave_out_the_error(tmp_path):
    assert draw(tmp_path, switched_run(), None) == ["map", "view", "timeline", "grey_mean", "pose"]


def test_figures_with_truth_of_another_time_leave_out_the_error(tmp_path):
    late = GroundTruth(trajectory=loop(200, START_NS + 10**12))
    assert draw(tmp_path, switched_run(), late) == ["map", "view", "timeline", "grey_mean", "pose"]


def test_run_without_images_has_no_grey_mean(tmp_path):
    run = switched_run()
    silent = [e for e in run.events if e["event"] != "vote"]
    blind = [{**e, "value": None} if e["event"] == "vote" else e for e in run.events]
    assert "grey_mean" not in draw(tmp_path / "silent", replace(run, events=silent), None)
    assert "grey_mean" not in draw(tmp_path / "blind", replace(run, events=blind), None)


def test_figures_survive_a_single_pose(tmp_path):
    names = draw(tmp_path, single_pose(), true_loop(), reference=loop(200))
    assert names == ["map", "timeline", "grey_mean", "error", "difference"]


def test_figures_survive_no_poses_and_no_observations(tmp_path):
    assert draw(tmp_path, poseless_run(30), true_loop(), reference=loop(3)) == ["timeline"]
    assert draw(tmp_path, poseless_run(0), None) == []


def test_figures_survive_two_million_points_and_14_thousand_poses(tmp_path):
    count = 14_000
    run = replace(switched_run(count, 6000, 7000), map=hybrid_map(2_000_000))
    names = draw(tmp_path, run, true_loop(count, 6000))
    assert names == ["map", "view", "timeline", "grey_mean", "error", "error_path", "pose"]


def test_report_opens_alone_and_embeds_every_figure(tmp_path):
    html = report(tmp_path, switched_run(), true_loop(), reference=loop(200))
    assert html.count("<svg ") == 8
    links = re.findall(r"(?:src|href)=\"(?!data:|#)", html)
    assert not links
    assert "http" not in re.sub(r"base64,[^\"]*", "", html)
    assert set(re.findall(r"url\((.)", html)) == {"#"}


def test_figures_of_a_page_refer_to_nothing_of_each_other(tmp_path):
    html = report(tmp_path, switched_run(), true_loop(), reference=loop(200))
    owners: dict[str, set[int]] = {}
    for number, svg in enumerate(html.split("<svg ")[1:]):
        for name in re.findall(r"(?:url\(|href=\")#(\w+)", svg.split("</svg>")[0]):
            assert f'id="{name}"' in svg, name
            owners.setdefault(name, set()).add(number)
    assert len(owners) > 10
    assert all(len(numbers) == 1 for numbers in owners.values())


def test_figures_of_the_report_round_no_number_that_is_read(tmp_path):
    html = report(tmp_path, switched_run(), true_loop())
    assert re.search(r">RMS 0\.00\d m, max 0\.00\d m</text>", html)


def test_figures_take_the_colours_of_the_page(tmp_path):
    html = report(tmp_path, switched_run(), true_loop())
    drawn = html[html.index("<svg") : html.rindex("</svg>")]
    assert not re.search(r"#(?:222222|000000|ffffff|fbf3d0)", drawn, re.I)
    used = set(re.findall(r"var\((--[\w-]+)\)", html))
    defined = set(re.findall(r"(--[\w-]+):", html))
    assert used <= defined


def test_report_is_well_formed_html(tmp_path):
    class Balance(HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.open: list[str] = []

        def handle_starttag(self, tag, attrs):
            if tag not in ("meta", "img", "br"):
                self.open.append(tag)

        def handle_startendtag(self, tag, attrs):
            pass

        def handle_endtag(self, tag):
            assert self.open.pop() == tag

    parser = Balance()
    parser.feed(report(tmp_path, switched_run(), true_loop()))
    assert not parser.open


def test_report_tells_what_happened_in_words(tmp_path):
    html = report(tmp_path, switched_run(), true_loop())
    assert "At 10.0 s “laser” took over from “rgbd”" in html
    assert "the scene was confirmed to be Dark, 2.00 s after it really changed" in html
    assert "<td>3.5 ms</td>" in html


def test_report_tells_over_which_time_the_motion_is_compared(tmp_path):
    metrics = evaluate(switched_run(), true_loop(), settings=replace(SETTINGS, rpe_interval_s=2.5))
    shown = _numbers(metrics)
    assert "error of the motion over 2.5 s" in shown and "error over 2.5 s" in shown
    assert "over 1 s" not in shown


def test_report_of_a_run_whose_first_pose_came_late_says_so(tmp_path):
    html = report(tmp_path, without(switched_run(), slice(0, 15)), None)
    assert "from the first pose on (at 1.5 of 19.9 s), 100.0 % of the observations" in html
    assert "of observations from the first pose on with a pose" in html


def test_report_tells_how_many_observations_were_dropped(tmp_path):
    assert "45 more were dropped" in report(tmp_path, replace(switched_run(), dropped=45), None)


def test_report_escapes_what_it_is_given(tmp_path):
    evil = "<script>alert(1)</script> & $story ${x}"
    run = switched_run()
    fault = happened("fault", START_NS + 5 * PERIOD_NS, what=evil)
    run = replace(run, events=[*run.events, fault])
    html = report(tmp_path, run, None, config_yaml=evil, versions={evil: evil}, faults=[evil])
    assert "<script" not in html
    assert html.count("&lt;script&gt;alert(1)&lt;/script&gt; &amp; $story ${x}") >= 5


def test_report_lists_each_fault_once_and_not_endlessly(tmp_path):
    faults = ["depth was missing"] * 3 + [f"fault {k}" for k in range(40)]
    html = report(tmp_path, switched_run(), None, faults=faults)
    assert html.count("depth was missing") == 1
    assert "and 21 more (see events.jsonl)" in html


@pytest.mark.parametrize("run", [poseless_run(0), poseless_run(20), single_pose()])
@pytest.mark.parametrize("truth", [None, true_loop(), GroundTruth()])
def test_report_survives_runs_with_almost_nothing(tmp_path, run, truth):
    html = report(tmp_path, run, truth)
    assert "No module was replaced." in html
    assert "nan " not in re.sub(r"base64,[^\"]*", "", html).lower()


def test_images_of_changes_are_in_the_report_with_what_changed(tmp_path):
    run = switched_run()
    image = np.full((6, 8, 3), 90, np.uint8)
    change = {"event": "scene", "stamp_ns": START_NS, "scene": "Dark"}
    seen = KeyMoment(stamp_ns=int(run.observed_ns[0]), events=[change], image_bgr=image)
    html = report(tmp_path, replace(run, moments=(seen,)), true_loop())
    assert "Camera images at changes" in html and "0.0 s: scene Dark confirmed" in html
    assert "data:image/jpeg;base64," in html
    assert "Camera images at changes" not in report(tmp_path, run, true_loop())
