"""The synthetic logs of corridors: what they hold agrees with their own truth."""

import numpy as np
import pytest

from sceneslam.evaluation.relations import Relations, relation_errors
from sceneslam.experiments import corridors
from sceneslam.sources.carmen import Carmen
from sceneslam.types import planar
from sceneslam.types.trajectory import Trajectory


@pytest.fixture(scope="module", params=corridors.STYLES)
def folder(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    corridors.main([request.param, "3", str(folder), "150"])
    return folder


def test_the_log_has_the_relations_and_the_walls_that_the_truth_says(folder):
    truth = Trajectory.read_tum(folder / "truth.tum")
    errors = relation_errors(truth, Relations.read(folder / "corridors.relations"))
    assert errors["matched"] == errors["total"] >= 30
    assert errors["trans_mean_m"] < 1e-5 and errors["rot_mean_deg"] < 1e-3
    observations = list(Carmen(str(folder / "corridors.clf"), 80.0, None))
    assert len(observations) == len(truth)
    middle = len(observations[0].scan.ranges_m) // 2
    for observation in observations[20:120]:  # past the crossing, along the first corridor
        right_m, left_m = observation.scan.ranges_m[[0, -1]]
        assert 2.3 < right_m + left_m < 2.4 + 2 * 0.35 + 0.1
    ahead_m = observations[0].scan.ranges_m[middle]
    later_m = observations[40].scan.ranges_m[middle]
    driven_m = np.linalg.norm(truth.positions_m[40] - truth.positions_m[0])
    assert ahead_m > 28.0 or ahead_m - later_m == pytest.approx(driven_m, abs=0.1)


def test_wheels_are_off_by_per_cents(folder):
    true = planar.from_transforms(Trajectory.read_tum(folder / "truth.tum").T_world_base)
    odometry = np.array([o.T_odom_base for o in Carmen(str(folder / "corridors.clf"), 80.0, None)])
    wheels = planar.from_transforms(odometry)
    lengths_m = [np.hypot(*np.diff(one[:, :2], axis=0).T).sum() for one in (true, wheels)]
    assert 0.96 < lengths_m[1] / lengths_m[0] < 1.04 and lengths_m[0] >= 150.0
    assert np.hypot(*(true[-1, :2] - wheels[-1, :2])) > 0.2


def test_another_style_is_named(capsys):
    with pytest.raises(SystemExit, match="error: 'door', allowed are doors, bare, periodic"):
        corridors.main(["door", "1", "."])
