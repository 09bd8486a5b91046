"""The winner as a YAML file that composes like any other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from sceneslam.experiments.tune.study import Drawn


def write_overlay(path: Path, drawn: Drawn, scores: Mapping[str, Sequence[float]]) -> None:
    """Write the values as an overlay; `scores` (default, tuned) by split go into its head."""
    nested: dict[str, Any] = {}
    for key, value in drawn.items():
        *parents, last = key.split(".")
        node = nested
        for parent in parents:
            node = node.setdefault(parent, {})
        node[last] = value
    lines = [
        f"# {split}: score {tuned:.4g}, of the defaults {default:.4g}"
        for split, (default, tuned) in scores.items()
    ]
    head = ["# @package _global_", "# Tuned: --config-dir FOLDER/conf +experiment=tuned", *lines]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([*head, OmegaConf.to_yaml(nested)]))
