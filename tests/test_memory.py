"""The memory of moments stays within its bounds and keeps what a hand-over needs."""

from dataclasses import replace

import numpy as np
from fakes import PERIOD_NS, observation

from sceneslam.bus.bridge import Bridge
from sceneslam.bus.judging.recent import CovarianceMonitor
from sceneslam.bus.observation_buffer import BufferedObservation, ObservationBuffer
from sceneslam.types import se3
from sceneslam.types.observation import Tracking, TrackingStatus


def tracked(index):
    return Tracking(
        stamp_ns=index * PERIOD_NS, T_local_base=se3.identity(), status=TrackingStatus.TRACKING
    )


def moment(index, *, is_trusted=True, has_pose=True, is_tracked=True):
    image = np.zeros((100, 100, 3), np.uint8)  # 30 kB
    return BufferedObservation(
        observation=replace(observation(index), image_bgr=image),
        T_map_base=se3.identity() if has_pose else None,
        module="a",
        bridge=Bridge(is_active=True),
        turn=None,
        tracking=tracked(index) if is_tracked else None,
        is_trusted=is_trusted,
    )


def filled(count, *, limit_mb=100.0, span_s=5.0, keeps_sensors=True, **kinds):
    memory = ObservationBuffer(span_s=span_s, limit_mb=limit_mb, keeps_sensors=keeps_sensors)
    for index in range(count):
        memory.add(moment(index, **{name: kind(index) for name, kind in kinds.items()}))
    return memory


def test_memory_forgets_what_is_older_than_its_span():
    moments = filled(100).after(-1)
    assert [moments[0].stamp_ns, moments[-1].stamp_ns] == [49 * PERIOD_NS, 99 * PERIOD_NS]


def test_memory_thins_old_images_and_keeps_every_moment():
    moments = filled(100, limit_mb=0.6, span_s=60.0).after(-1)
    images = [index for index, m in enumerate(moments) if m.observation.image_bgr is not None]
    assert len(moments) == 100 and len(images) <= 20
    assert images[-3:] == [97, 98, 99] and images[0] == 0
    steps = np.diff(images)
    assert steps.max() <= 30 and (np.diff(steps) <= 6).all()  # the older, the wider apart
    assert all(m.observation.T_odom_base is not None for m in moments)


def test_memory_of_a_run_with_one_module_holds_one_image():
    moments = filled(20, keeps_sensors=False).after(-1)
    assert [m.observation.image_bgr is not None for m in moments] == [False] * 19 + [True]


def test_memory_of_one_module_holds_the_images_since_it_was_lost():
    memory = filled(20, keeps_sensors=False, is_tracked=lambda index: index < 12)
    held = [m.observation.image_bgr is not None for m in memory.after(-1)]
    assert held == [False] * 11 + [True] * 9
    memory.add(moment(20))
    assert [m.observation.image_bgr is not None for m in memory.after(-1)] == [False] * 20 + [True]


def test_anchor_is_the_newest_trusted_moment_before_the_scene_began():
    memory = filled(30, is_trusted=lambda index: index % 10 == 0)
    assert memory.anchor(None).stamp_ns == 20 * PERIOD_NS
    assert memory.anchor(19 * PERIOD_NS).stamp_ns == 10 * PERIOD_NS


def test_anchor_falls_back_on_the_newest_answer_the_oldest_pose_the_oldest_moment():
    never = lambda index: False  # noqa: E731
    late = filled(9, is_trusted=never, has_pose=lambda index: index >= 4)
    assert late.anchor(6 * PERIOD_NS).stamp_ns == 6 * PERIOD_NS
    assert late.anchor(3 * PERIOD_NS).stamp_ns == 4 * PERIOD_NS
    assert filled(9, is_trusted=never, has_pose=never).anchor(None).stamp_ns == 0


def test_what_lasts_becomes_usual():
    monitor = CovarianceMonitor()
    usual = [monitor.is_usual(1e-6 * np.eye(6)) for _ in range(100)]
    unusual = [monitor.is_usual(1e-2 * np.eye(6)) for _ in range(200)]
    assert all(usual) and not any(unusual[:99]) and all(unusual[100:])


def test_one_pose_that_is_surer_than_all_others_makes_none_unusual():
    """A module's first pose is where its frame begins."""
    monitor = CovarianceMonitor()
    answers = [monitor.is_usual(scale * np.eye(6)) for scale in (1e-9, 1e-6, 1e-6, 1e-6)]
    assert answers[0] and all(answers[2:])
