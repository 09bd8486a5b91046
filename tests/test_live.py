"""Live mode: paced, the newest of every sensor first, every loss counted, silence named."""

import signal
import threading
from time import monotonic

import numpy as np
import pytest

from sceneslam.engine.live import LiveSettings, LiveTally, Spent, StepInterrupt, run_live
from sceneslam.engine.mailbox import Mailbox, Waited
from sceneslam.sources.contract.rising_live import RisingLive
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Camera, Rig, Sensor

IMAGE = np.zeros((2, 2, 3), np.uint8)
AT_ONCE = LiveSettings(rate=100.0)
GYRO = np.array([[-0.01, 0.0, 0.0, 1.0]])


def observations(count, period_ns, **fields):
    for index in range(count):
        yield Observation(stamp_ns=index * period_ns, **fields)


def scan(stamp_ns):
    return LaserScan(
        stamp_ns=stamp_ns,
        ranges_m=np.ones(3, np.float32),
        angle_min_rad=0.0,
        angle_step_rad=0.1,
        range_min_m=0.1,
        range_max_m=10.0,
    )


class Run:
    """What was taken, and what was noted of the input."""

    def __init__(self, source, *, settings=AT_ONCE, step=None, feed=None):
        self.taken, self.events = [], []
        self.tally = run_live(
            iter(source), step or self.take, self.events.append, settings=settings, feed=feed
        )

    def take(self, observation):
        self.taken.append(observation)
        return True


class Feed:
    """Measured a second before it came; closing it ends the source."""

    def __init__(self):
        self.noticed, self.is_closed = [], threading.Event()

    def measured_ns(self, observation):
        return 0

    def notices(self):
        told, self.noticed = self.noticed, []
        return told

    def close(self):
        self.is_closed.set()


@pytest.mark.parametrize(("rate", "least_s"), [(1.0, 0.1), (2.0, 0.05)])
def test_observations_come_at_the_pace_of_their_stamps(rate, least_s):
    began_s = monotonic()
    run = Run(observations(6, 20_000_000), settings=LiveSettings(rate=rate))
    assert monotonic() - began_s >= least_s
    assert len(run.taken) + run.tally.dropped == 6
    assert len(run.tally.latencies_ms) == len(run.taken) and min(run.tally.latencies_ms) >= 0.0


def test_slow_step_gets_the_newest_and_the_rest_are_counted():
    gate, taken = threading.Event(), []

    def slow_step(observation):
        taken.append(observation.stamp_ns)
        gate.wait(5.0)
        return True

    def feed():
        yield from observations(50, 1, image_bgr=IMAGE)
        gate.set()

    tally = Run(feed(), step=slow_step).tally
    assert taken[-1] == 49 and len(taken) + tally.dropped == 50 and tally.dropped > 0
    assert tally.dropped_images == tally.dropped


def test_step_runs_in_its_own_thread_and_its_error_is_raised():
    def step(observation):
        raise ValueError(threading.current_thread().name)

    with pytest.raises(ValueError, match="bus"):
        Run(observations(5, 1), step=step)


def test_error_of_the_source_is_raised_after_what_came_before_it():
    taken = []

    def broken():
        yield from observations(1, 1)
        raise ValueError(threading.current_thread().name)

    with pytest.raises(ValueError, match="source"):
        Run(broken(), step=lambda o: taken.append(o) or True)
    assert len(taken) == 1


def test_recording_that_is_read_too_slowly_is_played_later_and_says_so():
    def slow():
        for index, observation in enumerate(observations(4, 10**9, image_bgr=IMAGE)):
            if index == 1:
                threading.Event().wait(1.2)
            yield observation

    run = Run(slow(), settings=LiveSettings(rate=10.0))  # 0.1 s apart: a busy machine takes them
    assert len(run.taken) == 4 and max(run.tally.latencies_ms) < 500
    (behind,) = [one for one in run.events if one["event"] == "behind"]
    assert behind["by_s"] == pytest.approx(1.1, abs=0.3)


def test_reading_is_no_latency_before_the_playback_is_delayed_either():
    def slow():
        for observation in observations(36, 30_000_000):
            threading.Event().wait(0.036)
            yield observation

    def step(observation):
        threading.Event().wait(0.002)
        return True

    run = Run(slow(), settings=LiveSettings(rate=10.0), step=step)  # every 3 ms
    assert len(run.tally.latencies_ms) == 36
    assert 2.0 <= np.median(run.tally.latencies_ms) < 50.0
    behind = next(one for one in run.events if one["event"] == "behind")
    assert behind["by_s"] == pytest.approx(1.0, abs=0.2)


def test_slowest_pose_is_kept_with_what_its_time_went_to():
    def step(observation):
        threading.Event().wait(0.1)
        return True

    spent = Spent(parts_ms={"bus": 100.0}, cpu_ms=1.0, beside=("dark starts",))
    tally = run_live(
        observations(1, 1, image_bgr=IMAGE), step, print, settings=AT_ONCE, spent=lambda: spent
    )
    slowest = tally.slowest.poses[0]
    assert slowest.latency_ms >= 95.0 and slowest.beside == ("dark starts",)
    assert set(slowest.parts_ms) == {"arriving", "waiting", "bus"}
    assert slowest.latency_ms == pytest.approx(max(tally.latencies_ms))


def test_interrupted_run_still_knows_what_it_cost():
    tally = LiveTally()

    def step(observation):
        if observation.stamp_ns >= 5 * 10**6:
            raise KeyboardInterrupt
        return True

    with pytest.raises(KeyboardInterrupt):
        run_live(observations(9, 10**6), step, print, settings=AT_ONCE, tally=tally)
    assert 0 < len(tally.latencies_ms) + tally.dropped < 9


def interrupt():
    signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)


@pytest.mark.usefixtures("heeds_ctrl_c")
def test_ctrl_c_is_raised_after_the_step_that_runs():
    ended = threading.Event()

    def step(observation):
        interrupt()
        threading.Event().wait(0.5)  # longer than the main thread looks for Ctrl-C
        ended.set()
        return True

    with pytest.raises(KeyboardInterrupt) as raised:
        run_live(observations(9, 10**6), step, print, settings=AT_ONCE)
    assert ended.is_set() and raised.type is KeyboardInterrupt


@pytest.mark.usefixtures("heeds_ctrl_c")
@pytest.mark.parametrize("times", [1, 2])
def test_step_that_does_not_return_is_waited_for_until_another_ctrl_c(monkeypatch, times):
    monkeypatch.setattr("sceneslam.engine.live._STEP_S", 0.2 if times == 1 else 60.0)
    monkeypatch.setattr("sceneslam.engine.live._RAISE_S", 0.2)
    is_raised, has_ended = threading.Event(), threading.Event()

    def step(observation):
        try:
            for wait_s in [0.3, 0.0][-times:]:
                interrupt()
                is_raised.wait(wait_s)
            is_raised.wait(60.0)  # as native code, which KeyboardInterrupt does not end
        except KeyboardInterrupt:
            has_ended.set()
            raise

    with pytest.raises(StepInterrupt):
        run_live(observations(9, 10**6), step, print, settings=AT_ONCE)
    assert not has_ended.is_set()
    is_raised.set()
    assert has_ended.wait(60.0)


@pytest.mark.usefixtures("heeds_ctrl_c")
def test_step_that_does_not_return_is_ended_where_it_runs_python(monkeypatch):
    monkeypatch.setattr("sceneslam.engine.live._STEP_S", 0.2)

    def step(observation):
        interrupt()
        while True:
            threading.Event().wait(0.01)

    with pytest.raises(KeyboardInterrupt) as raised:
        run_live(observations(9, 10**6), step, print, settings=AT_ONCE)
    assert raised.type is KeyboardInterrupt


def test_step_can_end_the_run_while_the_source_is_silent():
    """A driver that hangs does not hold the end of the run."""
    feed = Feed()

    def hangs():
        yield Observation(stamp_ns=0)
        feed.is_closed.wait(60.0)

    began_s = monotonic()
    Run(hangs(), step=lambda o: False, feed=feed)
    assert feed.is_closed.is_set() and monotonic() - began_s < 2.0


def test_silent_source_is_named_and_named_again_when_it_is_back():
    feed, gate = Feed(), threading.Event()

    def pauses():
        yield Observation(stamp_ns=5)
        gate.wait(5.0)
        yield Observation(stamp_ns=7)

    settings = LiveSettings(silent_after_s=0.05)
    events = []

    def note(event):
        events.append(event)
        gate.set()  # once it is told silent

    run_live(iter(pauses()), lambda o: True, note, settings=settings, feed=feed)
    assert events == [
        {"event": "silent", "stamp_ns": 5, "for_s": 0.05},
        {"event": "returned", "stamp_ns": 7},
    ]


def test_source_that_stays_silent_ends_the_run_where_that_is_wanted():
    feed = Feed()

    def ends():
        yield Observation(stamp_ns=0)
        feed.is_closed.wait(60.0)

    run = Run(ends(), settings=LiveSettings(silent_after_s=0.05, end_after_s=0.1), feed=feed)
    assert [event["event"] for event in run.events] == ["silent", "given_up"]


def test_what_the_feed_tells_is_noted_before_the_observation_after_it():
    feed, order = Feed(), []

    def jumps():
        feed.noticed = [{"event": "clock_jump", "stamp_ns": 1}]
        yield Observation(stamp_ns=1)

    run_live(
        jumps(),
        lambda o: order.append("step") or True,
        lambda event: order.append(event["event"]),
        settings=AT_ONCE,
        feed=feed,
    )
    assert order == ["clock_jump", "step"]


def test_samples_and_scan_of_a_dropped_observation_are_kept():
    mailbox = Mailbox()
    mailbox.put(Observation(stamp_ns=0, gyro_base=GYRO, scan=scan(0), image_bgr=IMAGE))
    mailbox.put(Observation(stamp_ns=100_000_000, gyro_base=GYRO, image_bgr=IMAGE))
    merged = mailbox.take()
    np.testing.assert_allclose(merged.gyro_base[:, 0], [-0.11, -0.01])
    assert merged.scan.stamp_ns == 0 and merged.stamp_ns == 100_000_000
    assert (mailbox.dropped, mailbox.dropped_images) == (1, 1)


def test_every_third_image_still_brings_every_scan():
    """Images at 30 Hz, scans at 10 Hz, between the images that are taken."""
    mailbox, scans = Mailbox(), 0
    for index in range(90):
        stamp_ns = index * 33_333_333
        held = scan(stamp_ns - 10_000_000) if index % 3 == 1 else None
        mailbox.put(Observation(stamp_ns=stamp_ns, image_bgr=IMAGE, scan=held))
        if index % 3 == 0:
            scans += mailbox.take().scan is not None
    assert scans == 29


def test_image_is_not_replaced_by_an_observation_without_one():
    mailbox = Mailbox()
    mailbox.put(Observation(stamp_ns=0, image_bgr=IMAGE))
    mailbox.put(Observation(stamp_ns=1, scan=scan(1)))
    mailbox.put(Observation(stamp_ns=2, scan=scan(2)))
    assert [mailbox.take().stamp_ns for _ in range(2)] == [0, 2]
    assert mailbox.dropped == 1 and mailbox.take(0.0) is Waited.SILENCE
    mailbox.close()
    assert mailbox.take() is Waited.END


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ({"rate": 0.0}, "rate"),
        ({"silent_after_s": 0.0}, "silent_after_s"),
        ({"silent_after_s": float("nan")}, "silent_after_s"),
        ({"end_after_s": 0.5}, "end_after_s"),
    ],
)
def test_impossible_times_are_refused(words, key):
    with pytest.raises(ConfigError, match=key):
        LiveSettings(**words)


def test_jump_of_a_live_robots_odometry_is_told_with_what_it_is_moved_by():
    """Who publishes map -> odom needs what the wheels said, not what was made of it."""
    feed = Feed()

    class Wheels:
        rig, faults = Rig(sensors=frozenset({Sensor.ODOMETRY})), ()

        def __iter__(self):
            for index in range(10):
                T_odom_base = np.eye(4)
                T_odom_base[0, 3] = 0.1 * index + (50.0 if index >= 5 else 0.0)
                yield Observation(stamp_ns=index * 100_000_000, T_odom_base=T_odom_base)

    source = RisingLive(Wheels(), feed)
    ways_m = [observation.T_odom_base[0, 3] for observation in source]
    np.testing.assert_allclose(ways_m, 0.1 * np.arange(10), atol=1e-6)
    (event,) = source.notices()
    assert event["event"] == "odometry_jump" and event["stamp_ns"] == 500_000_000
    np.testing.assert_allclose(np.reshape(event["T_smooth_odom"], (4, 4))[0, 3], -50.0, atol=1e-6)


def test_live_observation_behind_the_one_before_is_left_out_at_once():
    class Backwards:
        rig, faults = Rig(sensors=frozenset({Sensor.IMAGE})), ()

        def __iter__(self):
            for stamp_ns in (5, 9, 7, 11):
                yield Observation(stamp_ns=stamp_ns, image_bgr=IMAGE)

    source = RisingLive(Backwards(), Feed())
    assert [observation.stamp_ns for observation in source] == [5, 9, 11]
    assert "its stamp does not rise: 1 time" in source.faults[0]


def test_live_image_of_another_size_than_the_cameras_is_left_out():
    height, width, _ = IMAGE.shape
    camera = Camera(size_wh=(width, height), fx=5.0, fy=5.0, cx=4.0, cy=3.0)

    class Halved:
        rig, faults = Rig(sensors=frozenset({Sensor.IMAGE}), camera=camera), ()

        def __iter__(self):
            yield Observation(stamp_ns=1, image_bgr=IMAGE)
            yield Observation(stamp_ns=2, image_bgr=IMAGE[::2, ::2])

    source = RisingLive(Halved(), Feed())
    assert [observation.image_bgr is not None for observation in source] == [True, False]
    assert "image_bgr was left out, it has" in source.faults[0]
