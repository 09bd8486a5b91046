"""Locking of the folder of a run or sweep before Hydra writes to it."""

from __future__ import annotations

import sys
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from sceneslam.storage.folder import RunFolder
from sceneslam.types.errors import SceneSlamError
from sceneslam.types.input_files import given_path

_UNUSABLE = 2  # exit code: nothing was run


class ClaimFolder(Callback):
    """Called by Hydra between composing and running (`hydra.callbacks`)."""

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Lock `hydra.run.dir`."""
        self._claim(config, "run")

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Lock `hydra.sweep.dir`."""
        self._claim(config, "sweep")

    def _claim(self, config: DictConfig, kind: str) -> None:
        """Lock the folder for this run; if its name is a time and exists, add a number.

        Hydra turns any exception but this one into a warning.
        """
        key = f"hydra.{kind}.dir"
        node = config.hydra[kind]
        raw = str(OmegaConf.to_container(node, resolve=False)["dir"])  # type: ignore[index,call-overload]
        try:
            self._folder = RunFolder.claim(
                given_path(str(node.dir)), kind=kind, is_stamped="${now:" in raw, key=key
            )
        except SceneSlamError as error:
            sys.stderr.write(f"error: {error}\n")
            raise SystemExit(_UNUSABLE) from error
        with read_write(config), open_dict(config):
            node.dir = str(self._folder.path)
