"""What travels between processes arrives as it was."""

from dataclasses import fields, replace

import numpy as np
import pytest
from fakes import observation
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sceneslam.supervision.messages import LogLine, Reply, Request
from sceneslam.supervision.packing import put_together, take_apart
from sceneslam.types.observation import LaserScan, Observation, Tracking, TrackingStatus


def sent(value):
    large = []
    item = take_apart(value, large)
    return put_together(item, [np.frombuffer(bytes(part), np.uint8) for part in large])


def assert_same(one, two):
    assert type(one) is type(two)
    if isinstance(one, np.ndarray):
        assert one.dtype == two.dtype and one.shape == two.shape
        np.testing.assert_array_equal(one, two)
    elif isinstance(one, (Observation, LaserScan, Tracking, Request, Reply)):
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(two, field.name))
    else:
        assert one == two


TRACKING = Tracking(
    stamp_ns=2**62,
    T_local_base=np.eye(4) / 3.0,
    status=TrackingStatus.DEGRADED,
    covariance=np.eye(6) * 1e-300,
    quality_ratio=np.float64(0.25),
    inliers=7,
)


@pytest.mark.parametrize("size", [2, 300])
def test_an_observation_with_every_sensor_arrives_as_it_was(size):
    scan = LaserScan(
        stamp_ns=3,
        ranges_m=np.array([1.0, np.inf, np.nan], np.float32),
        angle_min_rad=-1.0,
        angle_step_rad=0.1,
        range_min_m=0.0,
        range_max_m=9.0,
    )
    given = replace(
        observation(5),
        image_bgr=np.arange(size * size * 3, dtype=np.uint8).reshape(size, size, 3),
        depth_m=np.ones((size, size), np.float32)[:, ::-1],
        scan=scan,
        points_lidar=np.zeros((0, 3), np.float32),
        point_times_s=np.linspace(0.0, 1.0, size),
    )
    assert_same(sent(Request(number=1, method="track", arguments=(given,))).arguments[0], given)


def test_an_answer_arrives_to_the_bit_whatever_its_numbers_are():
    reply = Reply(number=1, value=TRACKING)
    assert_same(sent(reply), reply)


@pytest.mark.parametrize(
    "value",
    [
        (),
        (1, ("two", None), 2.5, True),
        {"a": [1, 2]},
        np.array(["text"], object),
        np.float32(1.5),
        np.zeros((100, 100), np.complex128),
        LogLine(logger="one", level=10, text="said"),
    ],
)
def test_any_other_value_arrives_too(value):
    assert_same(sent(value), value)


@given(
    arrays.arrays(
        st.sampled_from([np.float64, np.float32, np.uint8, np.int64, np.bool_]),
        arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=20),
    )
)
def test_arrays_of_all_shapes_arrive_as_they_were(array):
    assert_same(sent(array), array)
    assert_same(sent(array.T), np.ascontiguousarray(array.T) if array.ndim > 1 else array)
