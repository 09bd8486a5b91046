"""What every SLAM module in `conf/slam` must do: the contract of `interfaces.SlamModule`."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fakes import ExactModule
from hydra.utils import instantiate
from isolation import isolating
from omegaconf import OmegaConf

from sceneslam.modules.slam.odometry import Odometry
from sceneslam.testing import MODULE_CHECKS, ContractError, check_module, room_observation
from sceneslam.types.trajectory import Trajectory

CONF = Path(__file__).parents[1] / "conf"
# A ROS 2 node answers when it likes: tests/test_ros2_node.py
OTHERS = {CONF / "slam" / f"{name}.yaml" for name in ("ros2_node", "pipelined")}  # test_NAME.py
COMPONENTS = sorted(set((CONF / "slam").glob("*.yaml")) - OTHERS)
ISOLATED = Path("laser in its own process")
STEPS = 40
UNLIKE = {  # module and check -> why it is not held against it
    ("orb_slam3", "repeats_itself"): "its threads race: no two runs are the same to the bit",
    ("orb_slam3", "follows_a_known_motion"): "the room's equal squares mislead it by 0.2 m",
}
EXTRA = {
    "orb_slam3": "pyorbslam3",
    "genz_icp": "genz_icp",
    "rko_lio": "rko_lio",
}  # what a module needs that is not installed with the package


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Give the trajectory file that a module may ask for: the room's true poses."""
    path = tmp_path_factory.mktemp("recorded") / "room.tum"
    seen = [room_observation(index) for index in range(STEPS)]
    Trajectory(
        stamps_ns=np.array([one.stamp_ns for one in seen]),
        T_world_base=np.stack([one.T_odom_base for one in seen]),
    ).write_tum(path)
    return path


@pytest.fixture(params=[*COMPONENTS, ISOLATED], ids=lambda path: path.stem)
def make(request, recorded):
    """Give a function that builds the module anew from its YAML; one in a process of its own."""
    package = EXTRA.get(request.param.stem)
    if package and importlib.util.find_spec(package) is None:  # looked for, not imported: GPL
        pytest.skip(f"{package} is not installed")
    node = OmegaConf.load(COMPONENTS[0].parent / f"{request.param.stem.split(' ')[0]}.yaml")
    if OmegaConf.is_missing(node, "path"):
        node.path = str(recorded)
    if OmegaConf.is_missing(node, "command"):
        node.command = [sys.executable, str(Path(__file__).with_name("odometry_program.py"))]
    around = {"seed": 0, "run": OmegaConf.load(CONF / "run" / "recording.yaml")}
    config = OmegaConf.to_container(OmegaConf.merge(around, {"node": node}), resolve=True)
    build = partial(instantiate, config["node"], _convert_="all")
    if request.param is not ISOLATED:
        yield build
        return
    with isolating() as isolated:
        yield partial(isolated, build)


@pytest.mark.parametrize("check", MODULE_CHECKS, ids=lambda check: check.__name__)
def test_module_keeps_its_contract(make, check, request):
    reason = UNLIKE.get((request.node.callspec.id.split("-")[0], check.__name__))
    if reason:
        pytest.skip(reason)
    check(make)


def test_a_module_that_does_not_follow_is_found():
    with pytest.raises(ContractError, match=r"within 0\.05 m"):
        check_module(ExactModule)  # it knows the motion of another drive


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({"quality_ratio": float("nan")}, "quality_ratio: expected 0 to 1"),
        ({"revision": 1.0}, "revision: expected int, got float"),
        ({"map_covariance": -np.eye(6)}, "map_covariance: expected finite numbers"),
    ],
)
def test_what_the_bus_refuses_is_found(wrong, complaint):
    class Wrong(Odometry):
        def track(self, observation):
            return replace(super().track(observation), **wrong)

    with pytest.raises(ContractError, match=complaint):
        check_module(Wrong)


def test_a_trajectory_that_the_bus_refuses_is_found():
    class Nothing(Odometry):
        def get_trajectory(self):
            return None

    with pytest.raises(ContractError, match="get_trajectory's answer: expected Trajectory"):
        check_module(Nothing)


def test_numbers_of_numpy_are_accepted():
    class Numpys(Odometry):
        def track(self, observation):
            return replace(
                super().track(observation), revision=np.int64(0), can_begin=np.bool_(False)
            )

    check_module(Numpys)
