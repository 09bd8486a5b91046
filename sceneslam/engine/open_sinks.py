"""The open sinks of a run: one that fails is removed, and the run continues."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sceneslam.interfaces import CovarianceSink, MapSink, ResultSink, Sink, Steering
from sceneslam.types.command import Command
from sceneslam.types.errors import InputError, calling
from sceneslam.types.maps import MovedMap
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig
from sceneslam.types.run import Event, RunResult
from sceneslam.types.se3 import Transform
from sceneslam.types.truth import GroundTruth


@runtime_checkable
class SinkWithFiles(Protocol):
    """A sink that says whether it writes files; one that does not say is taken to write some."""

    @property
    def writes_files(self) -> bool:
        """Tell whether it has to be closed on a full disk."""
        ...


class OpenSinks:
    """Passes a run's results to its sinks; `faults` gets a sentence for each that failed."""

    def __init__(self, faults: list[str]) -> None:
        self._faults = faults
        self._sinks: dict[str, Sink] = {}

    def __len__(self) -> int:
        """Return how many sinks are open."""
        return len(self._sinks)

    def open(self, sinks: Mapping[str, Sink], rig: Rig, folder: Path) -> None:
        """Open all sinks by key; raises InputError for one that fails."""
        # Who steers a robot waits for poses; files do not.
        for key, sink in sorted(sinks.items(), key=lambda one: not isinstance(one[1], Steering)):
            self._sinks[key] = sink
            with calling(f"sinks.{key} could not be opened", InputError):
                sink.open(rig, folder)

    def commands(self) -> Sequence[Command]:
        """Return the operators' commands since the last call."""
        commands: list[Command] = []
        for key, sink in list(self._sinks.items()):
            with self._dropping(key):
                if isinstance(sink, Steering):
                    commands += sink.commands()
        return commands

    def write(
        self,
        observation: Observation,
        T_map_base: Transform | None,
        covariance: NDArray[np.float64] | None,
        module: str,
    ) -> None:
        """Pass an observation with its pose (4, 4) and covariance (6, 6)."""
        for key, sink in list(self._sinks.items()):
            with self._dropping(key):
                if isinstance(sink, CovarianceSink) and covariance is not None:
                    sink.write_covariance(observation.stamp_ns, covariance)
                sink.write(observation, T_map_base, module)

    @property
    def show_maps(self) -> bool:
        """Tell whether any sink shows a map while the run goes on."""
        return any(isinstance(sink, MapSink) for sink in self._sinks.values())

    def write_map(self, moved: MovedMap) -> None:
        """Pass where loops or a loaded map have moved the map."""
        for key, sink in list(self._sinks.items()):
            with self._dropping(key):
                if isinstance(sink, MapSink):
                    sink.write_map(moved)

    def write_events(self, events: Sequence[Event]) -> None:
        """Pass events to all sinks, to each a copy of its own."""
        for key, sink in list(self._sinks.items()):
            with self._dropping(key):
                for event in events:
                    sink.write_event(deepcopy(event))

    def close(self, truth: GroundTruth | None, result: Callable[[], RunResult]) -> None:
        """Pass the ground truth and the final results to the sinks, and close them."""
        for key, sink in list(self._sinks.items()):
            with self._dropping(key):
                if truth is not None:
                    sink.write_truth(truth)
                if isinstance(sink, ResultSink):
                    sink.write_result(result())
                sink.close()

    def drop_files(self, error: Exception) -> None:
        """Remove and close the sinks that write files because of an error."""
        for key, sink in list(self._sinks.items()):
            if not isinstance(sink, SinkWithFiles) or sink.writes_files:
                with self._dropping(key):
                    raise error

    def abandon(self) -> None:
        """Close all sinks without results."""
        for key in list(self._sinks):
            self._abandon(key)

    @contextmanager
    def _dropping(self, key: str) -> Iterator[None]:
        """Remove a sink that raises an error within, which is a fault of the run."""
        try:
            with calling(f"sinks.{key} stopped writing", InputError):
                yield
        except InputError as error:
            self._faults.append(str(error))
            self._abandon(key)

    def _abandon(self, key: str) -> None:
        """Close a sink, without an error if that fails."""
        with suppress(InputError), calling(f"sinks.{key} could not be closed", InputError):
            self._sinks.pop(key).close()
