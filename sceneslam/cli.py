"""The command line: composes the configuration, runs it, and says in a few lines what happened.

Exit codes: 0 all well; 1 the run ended early or its input was damaged, and what was computed is
saved; 2 nothing was run because the configuration or the input cannot be used.
"""

from __future__ import annotations

import os
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from sceneslam.app import Finished, run
from sceneslam.config.resolve import resolved
from sceneslam.config.settings import DETECT_ONLY
from sceneslam.detection.run import detect
from sceneslam.evaluation.summary import summary_lines
from sceneslam.evaluation.verdict import verdict_lines
from sceneslam.experiment import run_experiment
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
    from sceneslam.sweep.plugin import register

    codes: list[int] = []
    register()

    @hydra.main(version_base="1.3", config_path=CONFIG, config_name="config")
    def job(config: DictConfig) -> None:
        codes.append(OK)  # it has begun
        codes.append(carry_out(config).code)

    sys.argv[1:] = sorted(sys.argv[1:], key=_is_override)  # Hydra takes no option between them
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises then, and does not exit
    try:
        job()
        sys.stdout.flush()
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        print(f"error: {_said(error)}", file=sys.stderr)
        codes.append(UNUSABLE)
    except BrokenPipeError:  # as of `| head`: what was said went where it was wanted
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, RecursionError, ValueError) as error:  # Hydra's, before the job
        said = _meant(error)
        if codes or said is None:  # a run's own are handled in it
            raise
        print(f"error: {said}", file=sys.stderr)
        codes.append(UNUSABLE)
    except KeyboardInterrupt:  # ends a sweep as well
        codes.append(INCOMPLETE)
    sys.exit(max(codes, default=OK))


def _is_override(word: str) -> bool:
    return not word.startswith("-") and ("=" in word or word.startswith("~"))


def _said(error: Exception) -> str:
    """Return what Hydra says, with the words that it is about, and no advice that leads astray."""
    said = str(error)
    if isinstance(error, OverrideParseException) and error.override not in said:
        said = f"{error.override}: {said}"
    missing = str(getattr(error.__cause__, "full_key", None) or "of that name")
    if missing.startswith("scenes."):  # a table that may have more rows
        return said
    there = f"There is no key {missing}; --cfg job shows all"
    return re.sub(r"To append to your config use \+(.*)", there, said)


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
    return str(error) if str(error).startswith("Invalid defaults list") else None


def carry_out(config: DictConfig) -> Ended:
    """Run one job, say how it went and return how it ended; raises KeyboardInterrupt if stopped."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
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
        return Ended(code=UNUSABLE, errors=(str(error),))
    except KeyboardInterrupt:
        print("error: stopped before the first observation", file=sys.stderr)
        raise
    for fault in finished.faults:
        print(f"error: {fault}", file=sys.stderr)
    page = folder / "report.html"
    where = f"report   {_short(page)}" if page.exists() else f"results  {_short(folder)}"
    print("\n".join([*summary_lines(finished.metrics), where]))
    if finished.is_interrupted:
        raise KeyboardInterrupt
    return Ended(code=INCOMPLETE if finished.faults else OK, errors=finished.faults)


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
    return run(resolved(config), folder, title=title, reference=reference)


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
    return resolved(cast(DictConfig, other))


def _short(folder: Path) -> Path:
    """Return the folder as a user would type it."""
    here = Path.cwd()
    return folder.relative_to(here) if folder.is_relative_to(here) else folder
