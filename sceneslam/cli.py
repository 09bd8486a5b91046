"""The command line: composes the configuration, runs it, and prints a short summary.

Exit codes: 0 all input was used and nothing failed; 1 there is a result, but something is missing
or failed, as the `error:` lines say; 2 nothing was run, and one sentence says why.
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
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

import sceneslam
from sceneslam.app import Finished, run
from sceneslam.catalogue import listing
from sceneslam.config import files
from sceneslam.config.overlay import typed_words
from sceneslam.config.resolve import resolved
from sceneslam.config.settings import DETECT_ONLY
from sceneslam.config.words import (
    check_choices,
    check_trust,
    how_to_quote,
    is_override,
    readable,
    shortened,
    takes_rows,
)
from sceneslam.detection.run import detect
from sceneslam.doctor import examine
from sceneslam.evaluation.report.summary import summary_lines
from sceneslam.evaluation.shortfalls import REFERENCE
from sceneslam.evaluation.verdict import verdict_lines
from sceneslam.experiment import run_experiment
from sceneslam.interrupts import stop_raised
from sceneslam.leaving import leave_threads
from sceneslam.storage.folder import give_back
from sceneslam.streams import lost_output
from sceneslam.types.errors import ConfigError, SceneSlamError, text_of
from sceneslam.types.experiment import Verdict
from sceneslam.types.trajectory import Trajectory

OK, INCOMPLETE, UNUSABLE = 0, 1, 2
CONFIG = "pkg://sceneslam.conf"
_UNBEGUN = "stopped before the first observation"


@dataclass(frozen=True, slots=True, kw_only=True)
class Ended:
    """The result of a job: its exit code, and one sentence per error."""

    code: int
    errors: tuple[str, ...] = ()


def main() -> None:
    """Run `python -m sceneslam` and exit."""
    if "--version" in sys.argv[1:]:
        sys.exit(_tell(lambda: [f"SceneSLAM {sceneslam.__version__}"]))
    if sys.argv[1:2] == ["list"]:
        sys.exit(_tell(lambda: listing(sys.argv[2:])))
    if sys.argv[1:2] == ["doctor"]:
        sys.exit(_tell(lambda: examine(_words(sys.argv[2:]))))
    codes: list[int] = []
    files.register()

    @hydra.main(version_base="1.3", config_path=CONFIG, config_name="config")
    def job(config: DictConfig) -> None:
        codes.append(OK)  # the job has begun
        codes.append(carry_out(config).code)

    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises instead of exiting
    try:
        sys.argv[1:] = _words(sys.argv[1:]) or ["--help"]
        with stop_raised():
            job()
    except Exception as error:
        if codes and not isinstance(error, HydraException):  # errors of a run are handled there
            raise
        codes.append(_say(error))
    except SystemExit as stop:  # Hydra exits with 0 after --help, whatever was printed
        if stop.code:
            raise
    except KeyboardInterrupt as stop:  # also ends a sweep
        if not codes:
            print(f"error: {_UNBEGUN}", file=sys.stderr)
        codes.append(INCOMPLETE if codes and str(stop) != _UNBEGUN else UNUSABLE)
    # The results of a run are in its folder, whatever standard output lost.
    code = max(codes) if codes else _printed()
    leave_threads(code)
    sys.exit(code)


def _printed() -> int:
    """Return the exit code of a command whose result is on standard output alone."""
    lost = lost_output()
    if lost is None:
        return OK
    print(f"error: standard output: {text_of(lost)}", file=sys.stderr)
    return INCOMPLETE


def _tell(find: Callable[[], list[str]]) -> int:
    """Print the lines of `find`; return the exit code."""
    try:
        print("\n".join(find()))
    except SceneSlamError as error:
        return _say(error)
    except KeyboardInterrupt:
        return INCOMPLETE
    return _printed()


def _words(words: list[str]) -> list[str]:
    """Return the command line in Hydra's syntax: options before overrides, quoted paths."""
    is_sweep = bool({"-m", "--multirun"} & set(words))
    return [readable(word, is_sweep=is_sweep) for word in sorted(words, key=is_override)]


def _say(error: Exception) -> int:
    """Print why a job cannot be run, or its configuration cannot be shown."""
    print(f"error: {_said(error)}", file=sys.stderr)
    return UNUSABLE


def _said(error: Exception) -> str:
    """Return a sentence on an error before the first job, in terms of the command line."""
    if isinstance(error, OverrideParseException):
        return how_to_quote(error.override, str(error).removeprefix(f"{error.override}: "))
    if isinstance(error, MissingConfigException) and error.options:
        return _without_paths(error, error.options)
    if isinstance(error, HydraException):
        return _without_advice(error)
    if isinstance(error, SceneSlamError | OmegaConfBaseException | YAMLError):
        return str(error)
    return _meant(error) or f"the configuration cannot be composed: {shortened(text_of(error))}"


def _without_paths(error: MissingConfigException, options: Sequence[str]) -> str:
    """Return Hydra's message on an option that does not exist without the paths it looked in.

    The file that asks for it is named, unless it is `config`, which Hydra says of the command line.
    """
    group = re.findall(r"Available options in '(.+)':", str(error))[0]
    name = str(error.missing_cfg_file).removeprefix(f"{group}/")
    asking = re.match(r"In '(?!config')(.+?)':", str(error))
    said = str(ConfigError(group, name, f"one of {', '.join(options)}"))
    return f"{said} (in {asking[1]}.yaml)" if asking else said


def _without_advice(error: HydraException) -> str:
    """Return Hydra's message without misleading advice."""
    said = re.sub(r"use \+(slam|sinks)=", r"use +\1@\1.KEY=", str(error))  # each has a key
    missing = str(getattr(error.__cause__, "full_key", None) or "of that name")
    if takes_rows(getattr(error.__cause__, "parent_node", None)):
        return said
    there = f"There is no key {missing}; --cfg job shows all"
    return re.sub(r"To append to your config use \+(.*)", there, said)


def _meant(error: Exception) -> str | None:
    """Return a sentence for errors of Hydra that do not name the file or key; None: unknown."""
    if isinstance(error, OSError):
        return f"hydra.run.dir or hydra.sweep.dir: {text_of(error)}"
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
    """Run one job, print its summary and return its result; raises KeyboardInterrupt if stopped."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        with stop_raised():
            resolved(config)  # names a broken `${...}` before any key is read
            words = typed_words(HydraConfig.get().overrides.task)
            check_trust(config, words)
            check_choices(words)
        if config.get("experiment"):
            verdict = run_experiment(config, folder)
            print("\n".join([*verdict_lines(verdict), f"report  {_short(folder)}/report.html"]))
            return _ended(verdict)
        if OmegaConf.select(config, "run.mode") == DETECT_ONLY:
            faults = detect(resolved(config), folder, print)
            for fault in faults:
                print(f"error: {fault}", file=sys.stderr)
            return Ended(code=INCOMPLETE if faults else OK, errors=faults)
        finished = _run(config, folder)
    except SceneSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        give_back(folder)
        return Ended(code=UNUSABLE, errors=(str(error),))
    except OSError as error:  # what is in the folder stays, as of an experiment
        print(f"error: {text_of(error)}", file=sys.stderr)
        return Ended(code=UNUSABLE, errors=(text_of(error),))
    except KeyboardInterrupt as stop:
        is_experiment = bool(config.get("experiment"))  # whose trials may be finished
        said = str(stop) or ("stopped between the trials" if is_experiment else _UNBEGUN)
        print(f"error: {said}", file=sys.stderr)
        raise KeyboardInterrupt(said) from stop
    errors = (*finished.faults, *finished.metrics["shortfalls"])
    for sentence in errors:
        print(f"error: {sentence}", file=sys.stderr)
    page = folder / "report.html"
    where = f"report   {_short(page)}" if page.exists() else f"results  {_short(folder)}"
    print("\n".join([*summary_lines(finished.metrics), where]))
    if finished.is_interrupted:
        raise KeyboardInterrupt
    return Ended(code=_code(finished, errors), errors=errors)


def _ended(verdict: Verdict) -> Ended:
    """Return the result of an experiment; print which bounds do not hold."""
    failing = [figure.name for figure in verdict.figures if not figure.holds]
    if not failing:
        return Ended(code=OK)
    bounds = f"{len(failing)} of {len(verdict.figures)} bounds do not hold"
    error = f"{bounds}, first: {failing[0]}" if len(failing) > 1 else f"{bounds}: {failing[0]}"
    print(f"error: {error}", file=sys.stderr)
    return Ended(code=INCOMPLETE, errors=(error,))


def _code(finished: Finished, errors: Sequence[str]) -> int:
    """Return the exit code of a run that was not interrupted."""
    if not errors:
        return OK
    return INCOMPLETE if finished.metrics["observations"] else UNUSABLE


def _say_before(lines: str) -> None:
    """Print the survey of the input before the run."""
    print(lines, file=sys.stderr)


def _run(config: DictConfig, folder: Path) -> Finished:
    """Run the reference, if there is one, then the configuration itself."""
    choices = HydraConfig.get().runtime.choices
    title = str(choices.get("scenario") or choices.get("experiment") or "sceneslam")
    reference: Trajectory | None = None
    partial: tuple[str, ...] = ()
    if config.get("reference"):
        finished = run(_reference(config), folder / "reference", title="reference")
        if finished.faults:
            faults = tuple(f"{REFERENCE}{fault}" for fault in finished.faults)
            return replace(finished, faults=faults)
        if finished.is_stop_requested:
            raise KeyboardInterrupt(f"{_UNBEGUN}; the reference is saved")
        reference = finished.trajectory
        partial = tuple(f"{REFERENCE}{one}" for one in finished.metrics["shortfalls"])
    own = run(resolved(config), folder, title=title, reference=reference, say=_say_before)
    return replace(own, faults=(*partial, *own.faults))


def _reference(config: DictConfig) -> dict[str, Any]:
    """Return the configuration of the reference run."""
    allowed = "overrides of this configuration, as a table"
    if not isinstance(config.reference, DictConfig):
        raise ConfigError("reference", config.reference, allowed)
    try:
        own: dict[str, Any] = {"reference": None}
        if OmegaConf.select(config, "atlas.save") is not None:
            save = OmegaConf.select(config.reference, "atlas.save")  # not the run's
            own["atlas"] = {"save": save}
        other = OmegaConf.merge(config, config.reference, own)
    except OmegaConfBaseException as error:
        key = f"reference.{getattr(error, 'full_key', '') or ''}".rstrip(".")
        raise ConfigError(key, OmegaConf.to_container(config.reference), allowed) from error
    check_trust(cast(DictConfig, other), typed_words(HydraConfig.get().overrides.task))
    return resolved(cast(DictConfig, other))


def _short(folder: Path) -> Path:
    """Return the folder relative to the working folder if possible."""
    here = Path.cwd()
    return folder.relative_to(here) if folder.is_relative_to(here) else folder
