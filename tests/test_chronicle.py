from dataclasses import replace

from evaluation_runs import (
    PERIOD_NS,
    SETTINGS,
    happened,
    poseless_run,
    stamps,
    switched_run,
    true_loop,
)

from sceneslam.evaluation.metrics import evaluate
from sceneslam.evaluation.report.chronicle import chronicle


def tell(run, truth=None):
    metrics = evaluate(run, truth, settings=SETTINGS)
    return chronicle(run, metrics["switches"], value_label="mean of grey")


def situation(index, action="switch", **changed):
    values = {
        "scene": "Dark", "served_scene": "Bright", "active": "rgbd", "health": "held",
        "unheld_since_ns": 0, "is_blind": False,
        "verdict": {"action": action, "to": ["laser", "rgbd"], "reason": "scene"},
    }  # fmt: skip
    return happened("situation", int(stamps(200)[index]), **values | changed)


def run_with(*events, before=None):
    """A switched run with more events, in the order of their stamps, before the decision."""
    run = switched_run()
    at = next(k for k, e in enumerate(run.events) if e["event"] == "decision" and e["from"])
    told = [*run.events[:at], *events, *run.events[at:]]
    return replace(run, events=sorted(told, key=lambda event: event["stamp_ns"]))


def test_chronicle_of_a_switch_tells_scene_choice_and_change_by_time():
    entries = tell(switched_run(), true_loop())
    assert [entry.what for entry in entries] == [
        "First scene: Bright",
        "“rgbd” begins",
        "The scene changed from Bright to Dark",
        "“laser” takes over from “rgbd”",
    ]
    assert [entry.at_s for entry in entries] == [0.0, 0.0, 10.0, 10.0]
    assert entries[2].details == ("All images since 8.00 s agree, mean of grey 30 to 80.",)


def test_chronicle_says_what_a_switch_was_decided_on_and_what_it_cost():
    entries = tell(run_with(situation(100)), true_loop())
    told = " ".join(entries[-1].details)
    assert "The scene asks for it; “rgbd” was tracking." in told
    assert "Candidates, best first: laser, rgbd." in told
    assert "Error of the motion across it: 0.00" in told
    assert "Cost: 3.5 ms" in told


def test_chronicle_says_for_how_long_a_lost_module_was_bridged_and_by_what():
    lost = situation(100, health="lost", unheld_since_ns=int(stamps(200)[90]), is_blind=True)
    run = run_with(lost)
    events = [{**e, "reason": "lost"} if e["event"] == "decision" else e for e in run.events]
    told = tell(replace(run, events=events))[-1].details
    assert told[0] == "“rgbd” had been lost for 1.00 s; constant velocity bridged meanwhile."


def test_chronicle_says_what_was_revised_at_a_hand_over():
    at = int(stamps(200)[100])
    revised = happened("revised", at, from_ns=at - 20 * PERIOD_NS, poses=21)
    entries = tell(run_with(situation(100), revised))
    assert any("21 poses reported since then were replaced" in text for text in entries[-1].details)


def test_chronicle_tells_long_trouble_and_counts_short():
    changes = [(20, "lost"), (30, "tracking"), (40, "degraded"), (42, "tracking")]
    events = [
        happened("tracking", int(stamps(200)[k]), module="rgbd", status=status)
        for k, status in changes
    ]
    whats = [entry.what for entry in tell(run_with(*events))]
    assert "“rgbd” is lost for 1.0 s" in whats
    assert "Also, tracking was impaired once for less than 0.5 s" in whats
    assert not any("degraded" in what for what in whats)


def test_many_troubles_of_a_kind_are_summed_up_and_the_worst_is_named():
    lasted = {4: 10, 18: 10, 32: 7, 46: 12, 60: 10, 74: 10}  # from, for: in images of 0.1 s
    changes = dict.fromkeys(lasted, "degraded")
    changes |= {begin + count: "tracking" for begin, count in lasted.items()}
    events = [
        happened("tracking", int(stamps(200)[k]), module="rgbd", status=status)
        for k, status in sorted(changes.items())
    ]
    (entry,) = [entry for entry in tell(run_with(*events)) if entry.kind == "trouble"]
    assert (entry.at_s, entry.what) == (0.4, "“rgbd” is degraded 6 times from here on")
    assert entry.details == ("5.9 s in all, at most 1.2 s (at 4.6 s); the figure shows when.",)


def test_chronicle_tells_of_a_module_that_is_lost_from_its_first_observation_on():
    run = switched_run()
    lost = [e | {"status": "lost"} if e["event"] == "tracking" else e for e in run.events]
    lost = sorted((e for e in lost if e["event"] in ("vote", "tracking")), key=lambda e: e["event"])
    decided = [e for e in run.events if e["event"] == "decision"][:1]
    whats = [entry.what for entry in tell(replace(run, events=[*lost[:1], *decided, *lost[1:]]))]
    assert any(what.startswith("“rgbd” is lost for 19.9 s") for what in whats), whats


def test_chronicle_tells_trials_refusals_and_faults():
    at = int(stamps(200)[50])
    choice = {"scene": "Bright", "from_": "rgbd", "to": "laser", "reason": "lost"}
    events = [
        situation(50, "try", active="laser"),
        situation(51, "tell", active="rgbd"),
        happened("refused", at, why="lost", **choice),
        happened("refused", at, why="silent", **{**choice, "to": "depth"}),
        happened("fault", at, what="the wheels fell off"),
        happened("suspect", at, module="rgbd"),
        happened("dropped", at, count=0),
        happened("dropped", at, count=3),
    ]
    kinds = {entry.what: entry.kind for entry in tell(run_with(*events))}
    assert kinds["“laser” is tried again"] == "decision"
    assert kinds["“rgbd” stays for Dark"] == "decision"
    assert kinds["“laser” was not taken: it was lost itself"] == "decision"
    assert kinds["“depth” was not taken: it got no data"] == "decision"
    assert kinds["the wheels fell off"] == "fault"
    assert kinds["“rgbd” is rejected"] == "trouble"
    assert sum("dropped" in what for what in kinds) == 1


def test_nothing_happened_in_a_run_without_events():
    assert tell(poseless_run(3)) == []


def test_chronicle_tells_what_happened_to_the_input_of_a_live_run():
    at_ns = int(stamps(200)[50])
    entries = tell(
        run_with(
            happened("clock_jump", at_ns, topic="/scan", jumped_s=-100.0, shift_ns=1, paces=False),
            happened("stream_silent", at_ns, topic="/imu", for_s=1.0),
            happened("late", at_ns, topic="/imu"),  # too common for a story
        )
    )
    told = [entry.what for entry in entries if entry.kind == "trouble"]
    assert told == ["the clock of /scan jumped by -100 s", "/imu was silent for 1 s"]
