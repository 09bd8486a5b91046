"""Recovery of the results of a killed run from its journal and events."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.guarded import covariances_of, fused_map_of
from sceneslam.atlas.submaps.correction import Correction
from sceneslam.config.build import make_source
from sceneslam.config.component import ComponentBuilder
from sceneslam.config.provenance import provenance
from sceneslam.evaluation.metrics import Metrics
from sceneslam.evaluation.settings import EvaluationSettings
from sceneslam.interfaces import Source
from sceneslam.results import Results
from sceneslam.sources.changes.wrapped import logged_ns
from sceneslam.storage.journal import JOURNAL, Kept, read_journal
from sceneslam.types.errors import InputError, SceneSlamError, text_of
from sceneslam.types.files import PART, owned, replacing
from sceneslam.types.maps import MapLayers
from sceneslam.types.run import Event, RunResult, Timings
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

_NEVER_KEPT = (
    "the map that the active module had when the run was cut off, and what it would have revised",
    "what detector, bus and modules cost",
    "the sensor data that modules lacked",
    "the number of dropped observations",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovered:
    """The recovered results of a run, and the missing ones."""

    metrics: Metrics
    missing: tuple[str, ...]  # not recoverable, or damaged
    faults: tuple[str, ...]  # errors of saving


def recover(folder: Path, allowed: Sequence[str] = ()) -> Recovered:
    """Write the results of an interrupted run; raises InputError without a journal.

    `allowed` names the packages of the user that may hold its source. Where the source cannot be
    read, the journal stays.
    """
    config = _read_config(folder)
    # `allow_targets` of the file is ignored: only the user may allow code.
    # Submaps need observations, which the journal does not contain.
    poses_alone = {**(config.get("atlas") or {}), "load": None, "save": None, "mode": "extend"}
    trusted = {"allow_targets": list(allowed), "atlas": poses_alone}
    builder = ComponentBuilder(config | trusted)
    atlas = builder.make("atlas", Atlas)
    kept = read_journal(folder / JOURNAL, _Retold(atlas))
    missing = list(_NEVER_KEPT)
    if kept.torn_bytes:
        missing.append(f"{kept.torn_bytes} bytes of {JOURNAL}, which are torn")
    events = _events(folder, missing)
    with chdir(kept.head.began_in) if Path(kept.head.began_in).is_dir() else nullcontext():
        source, truth = _source(config, builder, missing)
        versions = provenance(config)
    results = Results(
        folder=folder,
        config=config,
        versions=versions,
        title=kept.head.title,
        evaluation=builder.make("evaluation", EvaluationSettings),
        has_report=bool((config.get("run") or {}).get("report", True)),
        value_label=kept.head.value_label,
        faults=[_sentence(atlas, kept), *(f"recovered without {what}" for what in missing)],
        source=source,
    )
    result = _result(atlas, kept, events, results.lose)
    results.save_trajectories(result)
    reference = _reference(folder, source, kept.observed_ns) if config.get("reference") else None
    metrics = results.save_rest(result, truth, reference=reference, has_costs=False)
    if not results.unsaved:
        _tidy(folder, is_final=source is not None)
    return Recovered(metrics=metrics, missing=tuple(missing), faults=tuple(results.unsaved))


class _Retold:
    """Repeats the journal's calls on an atlas."""

    def __init__(self, atlas: Atlas) -> None:
        self._atlas = atlas

    def add_observation(self, stamp_ns: int) -> None:
        self._atlas.report(stamp_ns)

    def add_session(self, module: str, T_map_local: Transform, T_new_told: Transform) -> None:
        self._atlas.begin_session(module, T_map_local, T_new_told)

    def add_local(self, stamp_ns: int, T_local_base: Transform) -> None:
        self._atlas.add_local(stamp_ns, T_local_base)

    def add_pose(
        self,
        stamp_ns: int,
        T_map_base: Transform,
        module: str,
        covariance: NDArray[np.float64] | None,
        map_covariance: NDArray[np.float64] | None,
    ) -> None:
        self._atlas.add(stamp_ns, T_map_base, module, covariance, map_covariance)

    def add_rewind(self, stamp_ns: int, T_new_told: Transform | None) -> None:
        self._atlas.rewind(stamp_ns, T_new_told)

    def add_correction(self, stamps_ns: NDArray[np.int64], T_new_old: NDArray[np.float64]) -> None:
        self._atlas.correct(Correction(stamps_ns=stamps_ns, T_new_old=T_new_old))

    def add_final(self, stamps_ns: NDArray[np.int64], T_new_old: NDArray[np.float64]) -> None:
        self._atlas.end_with(Correction(stamps_ns=stamps_ns, T_new_old=T_new_old))

    def add_end(self, session: int, revised: Trajectory) -> None:
        self._atlas.close_session(session, MapLayers(), revised)


def _read_config(folder: Path) -> dict[str, Any]:
    path = folder / "config.yaml"
    if not path.is_file():
        raise InputError(f"nothing to recover, there is no configuration: {path}")
    try:
        plain: Any = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    except (OmegaConfBaseException, YAMLError, ValueError) as error:
        raise InputError(f"not a configuration ({error}): {path}") from error
    if not isinstance(plain, dict):
        raise InputError(f"not a configuration (no table): {path}")
    return {str(key): value for key, value in plain.items()}


def _events(folder: Path, missing: list[str]) -> list[Event]:
    """Return the complete events; an incomplete last line is removed from the file."""
    path = folder / "events.jsonl"
    lines = path.read_bytes().split(b"\n") if path.is_file() else []
    events: list[Event] = []
    for number, line in enumerate(lines, start=1):
        try:
            events.append(json.loads(line))
        except ValueError:
            if any(lines[number - 1 :]):
                missing.append(f"the events from line {number} of events.jsonl on, which is torn")
            break
    try:
        with replacing(path) as file:
            file.writelines(json.dumps(event) + "\n" for event in events)
    except OSError as error:  # such as a full disk: the path matters more
        missing.append(f"a new events.jsonl: {text_of(error)}")
    return events


def _source(
    config: Mapping[str, Any], builder: ComponentBuilder, missing: list[str]
) -> tuple[Source | None, GroundTruth | None]:
    """Return the recording and its ground truth."""
    source, lost = None, "the ground truth and the stamps of the recording"
    try:
        source, lost = make_source(config, builder), "the ground truth"
        return source, source.ground_truth()
    except SceneSlamError as error:
        missing.append(f"{lost}: {error}")
    except Exception as error:  # any exception of a reader, if the recording has changed
        missing.append(f"{lost}: {text_of(error)}")
    return source, None


def _reference(
    folder: Path, source: Source | None, observed_ns: NDArray[np.int64]
) -> Trajectory | None:
    """Return the trajectory of the reference run, None where it has none.

    Its file has the recording's own stamps; it gets those of the observations, as poses have.
    """
    path = folder / "reference" / "trajectory.tum"
    if not path.is_file():
        return None
    found = Trajectory.read_tum(path)
    logged = logged_ns(source, observed_ns).tolist()
    measured_ns = dict(zip(logged, observed_ns.tolist(), strict=True))
    stamps_ns = [measured_ns.get(stamp_ns, stamp_ns) for stamp_ns in found.stamps_ns.tolist()]
    return found.stamped(np.array(stamps_ns, np.int64))


def _sentence(atlas: Atlas, kept: Kept) -> str:
    return (
        f"the run was cut off after {len(kept.observed_ns)} observations; these results, of "
        f"{len(atlas.online)} poses, were recovered from its journal"
    )


def _result(
    atlas: Atlas, kept: Kept, events: list[Event], fault: Callable[[str], None]
) -> RunResult:
    nothing: NDArray[np.float64] = np.zeros(0)
    return RunResult(
        observed_ns=kept.observed_ns,
        trajectory=atlas.trajectory,
        online=atlas.online,
        covariances=covariances_of(atlas, fault, wheels=kept.head.wheels),
        modules=atlas.pose_modules,
        sessions=atlas.sessions,
        map=fused_map_of(atlas, fault),
        events=events,
        timings=Timings(detector_us=nothing, bus_us=nothing, module_ms={}, wall_s=0.0),
        missing=None,
    )


def _tidy(folder: Path, *, is_final: bool) -> None:
    """Remove unfinished files, and the journal if the recovery is final."""
    unfinished = [name for name in owned(folder) if name.endswith(PART)]
    sinks = [name for name in unfinished if (folder / name.removesuffix(PART)).suffix == ".mcap"]
    journal = [JOURNAL] if is_final else []
    for name in [*journal, "reserve.bin", *(one for one in unfinished if one not in sinks)]:
        (folder / name).unlink(missing_ok=True)
