"""Runs for scripts and notebooks: `from sceneslam import run`."""

from __future__ import annotations

from contextlib import closing
from datetime import datetime
from pathlib import Path

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, OverrideParseException

from sceneslam import app
from sceneslam.config.check import check_no_reference, first_line
from sceneslam.config.files import check_names
from sceneslam.config.resolve import resolved
from sceneslam.config.words import check_trust, how_to_quote, quoted, readable
from sceneslam.storage.folder import RunFolder, give_back
from sceneslam.types.errors import ConfigError, SceneSlamError
from sceneslam.types.input_files import given_path

_STAMPED = "outputs/%Y-%m-%d/%H-%M-%S"


def run(
    *overrides: str, folder: str | Path | None = None, config_dir: str | Path | None = None
) -> app.Finished:
    """Run a configuration as the command line does; write its folder and return the result.

    `overrides` are words of the command line: `"+scenario=bright_to_dark", "source.path=FOLDER"`.
    Paths need no quotes there, also with blanks.
    `folder` is the folder of the results (`outputs/DATE/TIME`), `config_dir` a folder of your own
    configurations. Sweeps (`-m`), experiments and `reference` need the command line.

    Raises ConfigError or InputError if nothing could be run. Later failures are in the result's
    `faults`.
    """
    config = composed(overrides, config_dir)
    if config.get("experiment"):
        raise ConfigError("experiment", config["experiment"], "null: use python -m sceneslam")
    check_no_reference(config, "in a script: use python -m sceneslam")
    is_stamped = folder is None
    path = Path(datetime.now().strftime(_STAMPED)) if folder is None else given_path(str(folder))
    with closing(RunFolder.claim(path, is_stamped=is_stamped)) as claimed:
        try:
            return app.run(config, claimed.path, title=_title(overrides))
        except SceneSlamError:
            give_back(claimed.path)
            raise


def composed(overrides: tuple[str, ...], config_dir: str | Path | None) -> dict[str, object]:
    """Return the resolved configuration; raises ConfigError if it cannot be composed."""
    words = [readable(word, is_sweep=False) for word in overrides]
    if config_dir is not None:
        path = Path(config_dir).resolve()
        if not path.is_dir():
            raise ConfigError("config_dir", str(config_dir), "a folder that exists")
        check_names(path)
        words.append(f"hydra.searchpath=[{quoted(f'file://{path}')}]")
    GlobalHydra.instance().clear()  # a notebook may have initialised it before
    try:
        with initialize_config_module("sceneslam.conf", version_base="1.3"):
            config = compose("config", overrides=words)
    except OverrideParseException as error:
        reason = how_to_quote(error.override, first_line(error))
        raise ConfigError("overrides", error.override, f"an override ({reason})") from error
    except HydraException as error:
        allowed = f"overrides that compose ({first_line(error)})"
        raise ConfigError("overrides", list(overrides), allowed) from error
    check_trust(config, words)
    return resolved(config)


def _title(overrides: tuple[str, ...]) -> str:
    named = [word for word in overrides if word.lstrip("+").startswith("scenario=")]
    return named[-1].partition("=")[2] if named else "sceneslam"
