"""What there is to choose, and how a command line says so."""

from __future__ import annotations

from pathlib import Path

import pytest

from sceneslam.catalogue import GROUPS, first_sentence, listing
from sceneslam.types.errors import ConfigError

CONF = Path(__file__).parents[1] / "conf"


def test_every_option_is_listed_with_its_first_sentence():
    lines = listing([])
    options = [path for group in GROUPS for path in (CONF / group).rglob("*.yaml")]
    assert len(lines) == len(options) + len(GROUPS) + len(GROUPS) - 1  # a blank between groups
    for path in options:
        assert first_sentence(path), f"{path} begins with no comment"
        name = path.relative_to(CONF).with_suffix("").as_posix().split("/", 1)[1]
        assert any(line.split()[:1] == [name] for line in lines)


def test_every_group_of_the_configuration_is_listed():
    assert {path.name for path in CONF.iterdir() if path.is_dir()} - {"__pycache__"} == set(GROUPS)


def test_options_of_ones_own_are_listed(tmp_path):
    (tmp_path / "scenario").mkdir()
    (tmp_path / "scenario" / "barn.yaml").write_text("# @package _global_\n# Hay. And cows.\n")
    lines = listing(["scenario", "--config-dir", str(tmp_path)])
    assert any(line.split() == ["barn", "Hay"] for line in lines)


def test_option_of_ones_own_with_the_name_of_one_of_ours_is_refused(tmp_path):
    (tmp_path / "slam").mkdir()
    (tmp_path / "slam" / "laser.yaml").write_text("# A laser of mine.\n")
    with pytest.raises(ConfigError, match=r"^slam: got .*slam/laser.yaml', allowed: another name"):
        listing(["--config-dir", str(tmp_path)])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("# @package _global_\n# The paper's IV-A, Fig. 5: light. More.\n", "Fig. 5: light"),
        ("# Is it found?\n#   python -m x\n", "Is it found?"),
        ("# Two lines make\n# one sentence:\nkey: 1\n", "Two lines make one sentence"),
        ("key: 1 # not this\n", ""),
    ],
)
def test_first_sentence(tmp_path, text, sentence):
    path = tmp_path / "x.yaml"
    path.write_text(text)
    assert first_sentence(path).endswith(sentence) and bool(first_sentence(path)) == bool(sentence)


@pytest.mark.parametrize("words", [["scenarioss"], ["--config-dir", "nowhere"]])
def test_what_is_not_there_is_named(words):
    with pytest.raises(ConfigError, match=words[-1]):
        listing(words)
