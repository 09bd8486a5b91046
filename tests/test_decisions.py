"""A run's decisions follow from its folder alone."""

import json

from configured import config

from sceneslam.app import run
from sceneslam.decisions import main


def test_decisions_of_a_run_are_made_again_from_its_folder(tmp_path, capsys):
    run(config(), tmp_path)
    assert main([str(tmp_path)]) == 0
    assert "0 that do not follow from the log" in capsys.readouterr().out


def test_another_policy_would_have_decided_otherwise(tmp_path, capsys):
    run(config(), tmp_path)
    path = tmp_path / "events.jsonl"
    events = [json.loads(line) for line in path.read_text().splitlines()]
    for event in events:
        if event["event"] == "situation":
            event["health"] = "failed"
    path.write_text("".join(json.dumps(event) + "\n" for event in events))
    assert main([str(tmp_path)]) == 1
    assert "logged" in capsys.readouterr().out


def test_folder_without_a_run_is_named(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert str(tmp_path / "events.jsonl") in capsys.readouterr().err
