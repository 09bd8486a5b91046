"""The command line: composes the configuration, runs it, and says in a few lines what happened.

Exit codes: 0 all of the input was used and nothing failed; 1 there is a result, but something is
missing or failed, as each `error:` says; 2 nothing was run, and one sentence says why.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

import sceneslam
from sceneslam.app import Finished, run
from sceneslam.catalogue import listing
from sceneslam.config import files
from sceneslam.config.resolve import resolved
from sceneslam.config.settings import DETECT_ONLY
from sceneslam.config.words import check_trust, how_to_quote, is_override, readable, shortened
from sceneslam.detection.run import detect
from sceneslam.doctor import examine
from sceneslam.evaluation.summary import summary_lines
from sceneslam.evaluation.verdict import verdict_lines
from sceneslam.experiment import run_experiment
from sceneslam.storage.folder import give_back
from sceneslam.streams import lost_output
from sceneslam.types.errors import ConfigError, SceneSlamError, told
from sceneslam.types.trajectory import Trajectory

OK, INCOMPLETE, UNUSABLE = 0, 1, 2
CONFIG = "pkg://sceneslam.conf"


@dataclass(frozen=True, slots=True, kw_only=True)
class Ended:
    """How a job ended: its exit code, and what was wrong in one sentence each."""

    code: int
    errors: tuple[str, ...] = ()


def main() -> None:
    """Run `python -m sceneslam` and exit."""
    if "--version" in sys.argv[1:]:
        print(f"SceneSLAM {sceneslam.__version__}")
        sys.exit(OK)
    if sys.argv[1:2] == ["list"]:
        sys.exit(_tell(lambda: listing(sys.argv[2:])))
    if sys.argv[1:2] == ["doctor"]:
        sys.exit(_tell(lambda: examine(_words(sys.argv[2:]))))
    codes: list[int] = []
    files.register()

    @hydra.main(version_base="1.3", config_path=CONFIG, config_name="config")
    def job(config: DictConfig) -> None:
        codes.append(OK)  # it has begun
        codes.append(carry_out(config).code)

    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises then, and does not exit
    try:
        sys.argv[1:] = _words(sys.argv[1:]) or ["--help"]
        job()
    except Exception as error:
        if codes and not isinstance(error, HydraException):  # a run's own are handled in it
            raise
        codes.append(_say(error))
    except KeyboardInterrupt:  # ends a sweep as well
        codes.append(INCOMPLETE)
    if not codes and (lost := lost_output()):  # a run has its results elsewhere
        print(f"error: standard output: {told(lost)}", file=sys.stderr)
        codes.append(INCOMPLETE)
    sys.exit(max(codes, default=OK))


def _tell(find: Callable[[], list[str]]) -> int:
    """Print what is found; return the exit code."""
    try:
        print("\n".join(find()))
    except SceneSlamError as error:
        return _say(error)
    except KeyboardInterrupt:
        return INCOMPLETE
    return OK


def _words(words: list[str]) -> list[str]:
    """Return the command line as Hydra takes it: no option between overrides, paths in quotes."""
    is_sweep = bool({"-m", "--multirun"} & set(words))
    return [readable(word, is_sweep=is_sweep) for word in sorted(words, key=is_override)]


def _say(error: Exception) -> int:
    """Say what keeps a job from being run, or its configuration from being shown."""
    print(f"error: {_said(error)}", file=sys.stderr)
    return UNUSABLE


def _said(error: Exception) -> str:
    """Return what an error before the first job means, in words about what was typed."""
    if isinstance(error, OverrideParseException):
        return how_to_quote(error.override, str(error).removeprefix(f"{error.override}: "))
    if isinstance(error, HydraException):
        return _without_advice(error)
    if isinstance(error, SceneSlamError | OmegaConfBaseException | YAMLError):
        return str(error)
    return _meant(error) or f"the configuration cannot be composed: {shortened(told(error))}"


def _without_advice(error: HydraException) -> str:
    """Return what Hydra says without an advice that leads astray."""
    missing = str(getattr(error.__cause__, "full_key", None) or "of that name")
    if missing.startswith("scenes."):  # a table that may have more rows
        return str(error)
    there = f"There is no key {missing}; --cfg job shows all"
    return re.sub(r"To append to your config use \+(.*)", there, str(error))


def _meant(error: Exception) -> str | None:
    """Return what an error of Hydra's means that does not say which file or key; None: unknown."""
    if isinstance(error, OSError):
        return f"hydra.run.dir or hydra.sweep.dir: {told(error)}"
    if isinstance(error, RecursionError):
        return "defaults: a file is in its own list, or in that of a file in it"
    if isinstance(error, UnicodeDecodeError):
        near = bytes(error.object[max(0, error.start - 30) : error.start + 10])
        return f"a YAML file is not UTF-8 text, at {near.decode('ascii', 'replace')!r}"
    if str(error).startswith("Config group override must be"):
        empty = [word for word in sys.argv[1:] if re.fullmatch(r"[^.=]+(@[^=]+)?=(null)?", word)]
        return f"{', '.join(empty)}: a group holds options; ~GROUP removes"
    if str(error).startswith("Unable to configure"):
        return f"hydra.job_logging or hydra.hydra_logging: {error}: {error.__cause__}"
    return str(error) if str(error).startswith("Invalid defaults list") else None


def carry_out(config: DictConfig) -> Ended:
    """Run one job, say how it went and return how it ended; raises KeyboardInterrupt if stopped."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        check_trust(config, HydraConfig.get().overrides.task)
        if config.get("experiment"):
            verdict = run_experiment(config, folder)
            print("\n".join([*verdict_lines(verdict), f"report  {_short(folder)}/report.html"]))
            return Ended(code=OK)
        if OmegaConf.select(config, "run.mode") == DETECT_ONLY:
            print("\n".join(detect(resolved(config), folder)))
            return Ended(code=OK)
        finished = _run(config, folder)
    except SceneSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        give_back(folder)
        return Ended(code=UNUSABLE, errors=(str(error),))
    except KeyboardInterrupt:
        print("error: stopped before the first observation", file=sys.stderr)
        raise
    errors = (*finished.faults, *finished.metrics["shortfalls"])
    for sentence in errors:
        print(f"error: {sentence}", file=sys.stderr)
    page = folder / "report.html"
    where = f"report   {_short(page)}" if page.exists() else f"results  {_short(folder)}"
    print("\n".join([*summary_lines(finished.metrics), where]))
    if finished.is_interrupted:
        raise KeyboardInterrupt
    return Ended(code=_code(finished, errors), errors=errors)


def _code(finished: Finished, errors: Sequence[str]) -> int:
    """Return the exit code of a run that was not interrupted."""
    if not errors:
        return OK
    return INCOMPLETE if finished.metrics["observations"] else UNUSABLE


def _say_before(lines: str) -> None:
    """Show what is known of the input before it is run."""
    print(lines, file=sys.stderr)


def _run(config: DictConfig, folder: Path) -> Finished:
    """Run the reference, if there is one, then the configuration itself."""
    choices = HydraConfig.get().runtime.choices
    title = str(choices.get("scenario") or choices.get("experiment") or "sceneslam")
    reference: Trajectory | None = None
    if config.get("reference"):
        finished = run(_reference(config), folder / "reference", title="reference")
        if finished.faults:
            faults = tuple(f"reference: {fault}" for fault in finished.faults)
            return replace(finished, faults=faults)
        reference = finished.trajectory
    return run(resolved(config), folder, title=title, reference=reference, say=_say_before)


def _reference(config: DictConfig) -> dict[str, Any]:
    """Return the configuration of the run to compare with."""
    allowed = "overrides of this configuration, as a table"
    if not isinstance(config.reference, DictConfig):
        raise ConfigError("reference", config.reference, allowed)
    try:
        other = OmegaConf.merge(config, config.reference, {"reference": None})
    except OmegaConfBaseException as error:
        key = f"reference.{getattr(error, 'full_key', '') or ''}".rstrip(".")
        raise ConfigError(key, OmegaConf.to_container(config.reference), allowed) from error
    check_trust(cast(DictConfig, other), HydraConfig.get().overrides.task)
    return resolved(cast(DictConfig, other))


def _short(folder: Path) -> Path:
    """Return the folder as a user would type it."""
    here = Path.cwd()
    return folder.relative_to(here) if folder.is_relative_to(here) else folder
