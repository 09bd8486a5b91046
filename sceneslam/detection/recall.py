"""Cache of detector features: read from disk, or computed from the recording once."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import zipfile
import zlib
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from tqdm import tqdm

from sceneslam.config.provenance import code_sha256, input_sha256
from sceneslam.config.settings import RunSettings
from sceneslam.detection.features import RecordingFeatures, failures_named, measure
from sceneslam.interfaces import FeatureDetector, Source
from sceneslam.types.errors import text_of

_log = logging.getLogger(__name__)
_CACHE = "~/.cache/sceneslam"
_WITHOUT_EFFECT = ("progress", "workers")  # keys of a source that do not change its images


def recall(
    config: Mapping[str, Any], detector: FeatureDetector, source: Source, run: RunSettings
) -> RecordingFeatures:
    """Return the detector's features for all observations of the source.

    Raises InputError if the source cannot be read, ModuleError if the detector fails.
    """
    path = _path(config, detector)
    kept = _kept(path)
    if kept is not None:
        return kept
    with failures_named():
        detector.activate(source.rig)
    observations = islice(source, run.max_observations)
    bar = tqdm(observations, desc="features", unit="obs", disable=not run.progress)
    stamps_ns, values, is_there = measure(bar, detector)
    with failures_named():
        detector.shutdown()
    truth = source.ground_truth()
    scenes = truth.scenes if truth is not None and truth.scenes else None
    found = RecordingFeatures(
        stamps_ns=stamps_ns,
        values=values,
        is_there=is_there,
        scenes=scenes,
        faults=tuple(source.faults),
    )
    try:
        found.write(path)
    except OSError as error:
        _log.warning("the features are not kept for the next time: %s", text_of(error))
    return found


def _kept(path: Path) -> RecordingFeatures | None:
    """Return cached features, None without them or if their file is damaged."""
    try:
        return RecordingFeatures.read(path) if path.is_file() else None
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        _log.warning("cached features are damaged, %s: %s", text_of(error), path)
        return None


def _path(config: Mapping[str, Any], detector: FeatureDetector) -> Path:
    """Return the path of cached features, with a hash of everything that they depend on."""
    source = config["source"]
    node = config["detector"]
    depends_on = {
        "source": {name: value for name, value in source.items() if name not in _WITHOUT_EFFECT},
        "effects": config.get("effects"),
        "detector": {name: node.get(name) for name in ("_target_", *detector.feature_settings)},
        "max_observations": config["run"].get("max_observations"),
        "code": code_sha256(),
    }
    depends_on["input"] = input_sha256({**depends_on, "allow_targets": config.get("allow_targets")})
    text = json.dumps(depends_on, sort_keys=True, default=str)
    folder = source.get("cache_dir") or os.environ.get("SCENESLAM_CACHE_DIR") or _CACHE
    name = f"features_{hashlib.sha256(text.encode()).hexdigest()[:16]}.npz"
    return Path(folder).expanduser() / name
