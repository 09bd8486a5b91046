"""Sweeps with `run=detect_only`: all settings are evaluated on features computed once."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, QuotedString, Transformer
from hydra.errors import ConfigCompositionException
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from sceneslam.collect.flatten import flat
from sceneslam.collect.overview import overview
from sceneslam.collect.rows import ROWS, Row, Value, parsed
from sceneslam.collect.status import State
from sceneslam.collect.write import write_rows
from sceneslam.config.resolve import resolved, without_hydra
from sceneslam.detection.grid import Axis, Tried, try_all
from sceneslam.types.files import whole

_INNER = ("detector.", "policy.")  # keys that need no new composition and no new reading
_TOLD_ERRORS = 5  # shown; the table has all


def sweep_detection(
    context: HydraContext, config: DictConfig, words: Sequence[str], folder: Path
) -> bool:
    """Evaluate all combinations of overrides, write the table; return whether all succeeded."""
    parser = OverridesParser.create(config_loader=context.config_loader)
    overrides = {one.get_key_element(): one for one in parser.parse_overrides(list(words))}
    inner = {key: one for key, one in overrides.items() if key.startswith(_INNER)}
    axes = [Axis(key=key, values=list(_values(one))) for key, one in inner.items()]
    first = [_words(one)[0] for one in inner.values()]  # composing finds misspelt keys
    outer = [_words(one) for key, one in overrides.items() if key not in inner]
    cells = [_Cell.of(context, config, chosen, axes, first) for chosen in product(*outer)]
    for axis, word in zip(axes, first, strict=True):
        if not any(axis in cell.axes for cell in cells):  # no detector or policy has this key
            context.config_loader.load_sweep_config(config, [*cells[0].chosen, word])
    rows: list[Row] = []
    with tqdm(desc="sweep", unit="setting", mininterval=0.5) as bar:
        for cell in cells:
            for tried in try_all(resolved(without_hydra(cell.config)), cell.axes):
                rows.append(_row(len(rows), cell.chosen, tried))
                bar.update()
    with whole(folder / ROWS) as file:
        file.writelines(json.dumps(asdict(row)) + "\n" for row in rows)
    page = write_rows(folder, rows)
    print(overview(rows), end="")
    for cell in cells:
        absent = [axis.key for axis in axes if axis not in cell.axes]
        if absent:
            print(f"left out: {', '.join(absent)}, which {' '.join(cell.chosen)} does not have")
    for error in list(dict.fromkeys(row.error for row in rows if row.error))[:_TOLD_ERRORS]:
        print(f"error: {error}", file=sys.stderr)
    print(f"{len(rows)} settings\ntable    {folder}/table.csv\npage     {page}")
    return all(row.status == State.DONE.value for row in rows)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Cell:
    """A combination of the other overrides, and the axes whose keys it has."""

    chosen: Sequence[str]
    config: DictConfig
    axes: Sequence[Axis]

    @classmethod
    def of(
        cls,
        context: HydraContext,
        config: DictConfig,
        chosen: Sequence[str],
        axes: Sequence[Axis],
        first: Sequence[str],
    ) -> _Cell:
        """Compose a combination with the first value of every axis whose key it has."""
        compose = context.config_loader.load_sweep_config
        own = list(zip(axes, first, strict=True))
        try:
            composed = compose(config, [*chosen, *first])
        except ConfigCompositionException:
            plain = compose(config, list(chosen))
            own = [
                (axis, word)
                for axis, word in own
                if word.startswith("+") or OmegaConf.select(plain, axis.key, default=own) is not own
            ]
            composed = compose(config, [*chosen, *(word for _, word in own)])
        return cls(chosen=chosen, config=composed, axes=[axis for axis, _ in own])


def _row(number: int, chosen: Sequence[str], tried: Tried) -> Row:
    state = State.FAILED if tried.error else State.DONE
    return Row(
        name=str(number),
        status=state.value,
        error=tried.error,
        keys={**dict(map(parsed, chosen)), **{k: _cell(v) for k, v in tried.setting.items()}},
        metrics=flat(tried.metrics),
    )


def _cell(value: Any) -> Value:
    """Return a value for the table: numbers and text as they are, others as typed."""
    is_plain = isinstance(value, str | int | float) and not isinstance(value, bool)
    return cast(Value, value) if is_plain else json.dumps(value).replace('"', "")


def _words(override: Override) -> list[str]:
    """Return one override per value."""
    key = override.get_key_element()
    if override.is_sweep_override():
        return [f"{key}={value}" for value in override.sweep_string_iterator()]
    return [f"{key}={override.get_value_element_as_str()}"]


def _values(override: Override) -> Iterator[Any]:
    """Return an override's values."""
    if override.is_sweep_override():
        found: Iterator[Any] = override.sweep_iterator(Transformer.identity)
    else:
        found = iter([override.value()])
    return map(_plain, found)


def _plain(value: Any) -> Any:
    """Return a value, and those inside it, without the command line's quotes."""
    if isinstance(value, QuotedString):
        return value.text
    if isinstance(value, list):
        return [_plain(one) for one in value]
    if isinstance(value, dict):
        return {_plain(key): _plain(one) for key, one in value.items()}
    return value
