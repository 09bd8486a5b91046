"""Hydra's launcher and sweeper plugins: all jobs are composed before the first one begins."""

from __future__ import annotations

import hashlib
import pickle
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, cast

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus, configure_log, setup_globals
from hydra.errors import HydraException
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from sceneslam.collect.rows import ROWS
from sceneslam.collect.status import State, Status
from sceneslam.config.check import check_maps_apart
from sceneslam.config.overlay import typed_words
from sceneslam.config.resolve import without_hydra
from sceneslam.config.settings import DETECT_ONLY
from sceneslam.storage.folder import RunFolder, give_back
from sceneslam.sweep.detection import sweep_detection
from sceneslam.sweep.sweep import run_sweep
from sceneslam.types.errors import ConfigError, SceneSlamError

INCOMPLETE, UNUSABLE = 1, 2  # exit codes: not all jobs finished; nothing was run
COMPOSED = ".composed.pickle"  # a job's configuration with Hydra's own part


class SweepLauncher(Launcher):
    """Runs jobs by a backend; jobs that are already final in their folder are kept."""

    def __init__(self, backend: str, **settings: Any) -> None:
        plain = OmegaConf.to_container(OmegaConf.create(settings), resolve=True)
        self._launcher = {"backend": backend, **cast("dict[str, Any]", plain)}

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Set the sweep's configuration; jobs are processes, `task_function` is not used."""
        self._context, self._config = hydra_context, config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run the missing jobs; return the state of all jobs."""
        setup_globals()
        configure_log(self._config.hydra.hydra_logging, self._config.hydra.verbose)
        sweep = Path(self._config.hydra.sweep.dir).absolute()
        numbered = enumerate(job_overrides, start=initial_job_idx)
        configs = [self._compose(sweep, number, overrides) for number, overrides in numbered]
        folders = [Path(config.hydra.runtime.output_dir) for config in configs]
        if len(set(folders)) < len(folders):
            subdir = self._config.hydra.sweep.subdir
            raise ConfigError("hydra.sweep.subdir", subdir, "a folder of its own for every job")
        check_maps_apart(map(_maps, configs))
        for folder, config in zip(folders, configs, strict=True):
            _prepare(folder, config)
        (sweep / ROWS).unlink(missing_ok=True)  # of an earlier sweep of the detection alone
        run_sweep(sweep, folders, self._launcher, Path.cwd())
        return [_returned(*pair) for pair in zip(folders, configs, strict=True)]

    def _compose(self, sweep: Path, number: int, overrides: Sequence[str]) -> DictConfig:
        loader = self._context.config_loader
        config = loader.load_sweep_config(self._config, list(overrides))
        with open_dict(config):
            config.hydra.job.id = str(number)
            config.hydra.job.num = number
            config.hydra.sweep.dir = str(sweep)
            config.hydra.runtime.output_dir = str(sweep / str(config.hydra.sweep.subdir))
        return config


class GridSweeper(Sweeper):
    """All combinations of the given values, as Hydra's own sweeper, but composed once."""

    def __init__(self, params: Mapping[str, Any] | None) -> None:
        self._params = params or {}

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Set the sweep's configuration and make its launcher."""
        self._context, self._config = hydra_context, config
        self._launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> Sequence[JobReturn]:
        """Run all combinations; exit the program if not all are finished."""
        words = [*(f"{key}={value}" for key, value in self._params.items()), *arguments]
        folder = Path(self._config.hydra.sweep.dir)
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self._config, folder / "multirun.yaml")
        try:
            if OmegaConf.select(self._config, "run.mode") == DETECT_ONLY:
                return self._detect(words, folder)
            return self._launch(words)
        except SceneSlamError as error:
            print(f"error: {error}", file=sys.stderr)
            give_back(folder)
            raise SystemExit(UNUSABLE) from error
        except (HydraException, OmegaConfBaseException):
            give_back(folder)
            raise

    def _launch(self, words: list[str]) -> Sequence[JobReturn]:
        parser = OverridesParser.create(config_loader=self._context.config_loader)
        (jobs,) = BasicSweeper.split_arguments(parser.parse_overrides(words), None)
        returned = self._launcher.launch(jobs, initial_job_idx=0)
        if any(one.status is not JobStatus.COMPLETED for one in returned):
            raise SystemExit(INCOMPLETE)
        return returned

    def _detect(self, words: list[str], folder: Path) -> Sequence[JobReturn]:
        if not sweep_detection(self._context, self._config, words, folder):
            raise SystemExit(INCOMPLETE)
        return []


def register() -> None:
    """Register the launchers and sweepers of the YAML files beside this module.

    Hydra accepts plugins of its own namespace only; these files replace those that Hydra or an
    installed plugin registered under the same names.
    """
    for plugin in (SweepLauncher, GridSweeper):
        Plugins.instance().class_name_to_class[f"hydra_plugins.{plugin.__name__}"] = plugin
    for path in sorted(Path(__file__).parent.glob("conf/*/*.yaml")):
        ConfigStore.instance().store(
            name=path.stem,
            group=f"hydra/{path.parent.name}",
            node=OmegaConf.load(path),
            provider="sceneslam",
        )


def _maps(config: DictConfig) -> dict[str, Any]:
    """Return where a job's map is saved and loaded."""
    HydraConfig.instance().set_config(config)  # of which `${hydra:job.num}` is read
    return {key: OmegaConf.select(config, f"atlas.{key}") for key in ("save", "load")}


def _prepare(folder: Path, config: DictConfig) -> None:
    """Write a job's files, unless the same job is final in its folder.

    The same job keeps its status: it has results, until it runs again.
    """
    digest = hashlib.sha256(OmegaConf.to_yaml(without_hydra(config)).encode()).hexdigest()
    before = Status.read(folder)
    if before is not None and before.config_sha256 != digest:
        before = None  # of another job
    if before is not None and before.is_final(folder):
        return
    with closing(RunFolder.claim(folder, key="hydra.sweep.subdir")):
        with (folder / COMPOSED).open("wb") as file:
            pickle.dump(config, file)
        if before is None:
            overrides = typed_words(config.hydra.overrides.task)
            Status(state=State.WAITING, config_sha256=digest, overrides=overrides).write(folder)


def _returned(folder: Path, config: DictConfig) -> JobReturn:
    """Return a job's result in Hydra's format."""
    status = Status.read(folder)
    done = JobReturn()
    done.overrides = status.overrides if status else ()
    done.cfg, done.working_dir = config, str(Path.cwd())
    is_finished = status is not None and status.state is State.DONE
    done.status = JobStatus.COMPLETED if is_finished else JobStatus.FAILED
    if status is not None and not is_finished:
        done.return_value = HydraException(f"job {folder.name} {status.state.value}")
    return done
