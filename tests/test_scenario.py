"""The main job, small: a drive from light into dark through the simulator, twice."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SMALL = "source.camera.size_wh=[480,360] run.progress=false seed=50"  # a seed of its own


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Run the scenario twice: the second run reads what the first one rendered."""
    folder = tmp_path_factory.mktemp("runs")
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "SCENESLAM_CACHE_DIR": str(folder / "cache"),
    }
    for name in ("first", "second"):
        words = f"-m sceneslam +scenario=bright_to_dark {SMALL} hydra.run.dir={name}".split()
        done = subprocess.run(
            [sys.executable, *words],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=900,
        )
        assert done.returncode == 0, done.stderr
    return folder


def metrics_of(folder):
    return json.loads((folder / "metrics.json").read_text())


@pytest.mark.slow
def test_bright_to_dark_is_one_switch_and_an_accurate_trajectory(runs):
    metrics = metrics_of(runs / "first")
    (switch,) = metrics["switches"]
    assert (switch["from"], switch["to"], switch["scene"]) == ("bright", "dark", "Dark")
    assert 1.4 <= switch["confirm_delay_s"] <= 2.3 and switch["gap_s"] == 0.0  # 1.8
    assert metrics["coverage"] == 1.0 and metrics["false_switches"] == 0
    # 1.5 times what was measured: 0.0071 m, 0.0050 rad (seeds 50 to 55: 0.0032 to 0.0085 m), and
    # the largest length of seeds 50 to 57, 1.0037.
    assert metrics["ate_rmse_m"] <= 0.0108 and metrics["ate_rot_rad"] <= 0.0075
    assert abs(metrics["length_ratio"] - 1.0) <= 0.0056


@pytest.mark.slow
def test_second_run_is_identical_to_the_bit(runs):
    one, two = ((runs / name / "trajectory.tum").read_bytes() for name in ("first", "second"))
    assert one == two

    def decisions(name):
        lines = (runs / name / "events.jsonl").read_text().splitlines()
        return [line for line in lines if json.loads(line)["event"] != "cost"]

    assert decisions("first") == decisions("second")


@pytest.mark.slow
def test_run_folder_holds_map_figures_and_report(runs):
    folder = runs / "first"
    for name in ("map/points.ply", "map/grid.pgm", "map/grid.yaml", "report.html", "config.yaml"):
        assert (folder / name).stat().st_size > 0
    assert {path.stem for path in (folder / "figures").glob("*.png")} >= {
        "grey_mean",
        "map",
        "error",
    }
