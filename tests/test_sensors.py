"""Sensors as a table: what is true of all that are sampled, shown on the accelerometer."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from ros_recordings import make_source

from sceneslam.ros.writer import ObservationWriter
from sceneslam.sources.contract.clean import cleaned
from sceneslam.sources.faults import FaultLog
from sceneslam.testing import RIG, room_observation
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Laser, Lidar, Sensor

SAMPLED = [sensor for sensor in Sensor if sensor.is_sampled]


def test_every_sensor_has_its_field():
    assert {sensor.field for sensor in Sensor} <= {field.name for field in fields(Observation)}
    assert Sensor("accelerometer") is Sensor.ACCELEROMETER


@pytest.mark.parametrize("sensor", SAMPLED, ids=lambda sensor: sensor.value)
def test_samples_of_an_observation_that_is_passed_over_are_kept(sensor):
    older, newer = room_observation(0), room_observation(3)
    joined = getattr(newer.with_samples_of(older), sensor.field)
    np.testing.assert_allclose(joined[:, 0], [-0.11, -0.01], atol=1e-9)
    alone = replace(newer, **{sensor.field: None}).with_samples_of(older)
    np.testing.assert_allclose(getattr(alone, sensor.field)[:, 0], [-0.11], atol=1e-9)


@pytest.mark.parametrize("sensor", SAMPLED, ids=lambda sensor: sensor.value)
def test_samples_that_are_not_finite_are_left_out_and_counted(sensor):
    log = FaultLog()
    rows = np.array([[-0.02, 1.0, 2.0, 3.0], [-0.01, np.nan, 0.0, 0.0]])
    found = cleaned(replace(room_observation(0), **{sensor.field: rows}), log)
    np.testing.assert_array_equal(getattr(found, sensor.field), rows[:1])
    assert f"{sensor.value} sample" in log.sentences()[0]


@pytest.mark.parametrize("silent", [None, *SAMPLED], ids=str)
def test_a_recording_keeps_gyro_and_accelerometer_apart(tmp_path, silent):
    rig = replace(RIG, sensors=RIG.sensors - {silent})
    path = tmp_path / "inertial.mcap"
    written = [room_observation(index) for index in range(3)]
    if silent is not None:
        written = [replace(one, **{silent.field: None}) for one in written]
    writer = ObservationWriter(path, rig=rig, image_format="jpeg")
    for one in written:
        writer.write(one)
    writer.close()
    source = make_source("mcap", path)
    assert {one for one in source.rig.sensors if one.is_sampled} == set(SAMPLED) - {silent}
    for before, after in zip(written, source, strict=True):
        for sensor in SAMPLED:
            if sensor is silent:
                assert not after.has(sensor)
            else:
                found = getattr(after, sensor.field)
                np.testing.assert_allclose(found, getattr(before, sensor.field), atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "name", "intrinsics"),
    [
        (Camera, "T_base_cam", {"size_wh": (4, 3), "fx": 2.0, "fy": 2.0, "cx": 1.5, "cy": 1.0}),
        (Laser, "T_base_laser", {}),
        (Lidar, "T_base_lidar", {}),
    ],
)
def test_where_a_sensor_is_mounted_cannot_be_changed_by_who_gets_the_rig(kind, name, intrinsics):
    T_base_sensor = np.eye(4)
    for sensor in (kind(**intrinsics), kind(**intrinsics, **{name: T_base_sensor})):
        with pytest.raises(ValueError, match="read-only"):
            getattr(sensor, name)[0, 3] = 1.0
    T_base_sensor[0, 3] = 1.0
    assert getattr(sensor, name)[0, 3] == 0.0
