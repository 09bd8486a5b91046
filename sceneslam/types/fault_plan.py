"""Faults on purpose: which one strikes when, and what has struck."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic_ns

import numpy as np

from sceneslam.types.ranges import check_among, check_between, check_least


@dataclass(slots=True, kw_only=True)
class FaultPlan:
    """Draws faults from the seed and the stamp alone, each of which strikes once.

    What has struck is in the file `record`, one JSON object per line, written before it strikes:
    a process that is started again does not run into the fault that killed it.
    """

    kinds: Sequence[str]
    known: tuple[str, ...]  # the kinds that there are
    rate_ratio: float  # of the observations
    seed: int
    record: Path
    _struck: set[int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.kinds, self.record = tuple(self.kinds), Path(self.record)  # a YAML has list and text
        check_among(self.known, faults=self.kinds)
        check_between(0, 1, rate_ratio=self.rate_ratio)
        check_least(0, seed=self.seed)
        lines = self.record.read_text().splitlines() if self.record.exists() else []
        self._struck = {json.loads(line)["stamp_ns"] for line in lines}

    def begin_anew(self) -> None:
        """Forget what has struck, for a run whose source is read from its beginning."""
        self.record.unlink(missing_ok=True)
        self._struck.clear()

    def strike(self, stamp_ns: int) -> str | None:
        """Return the fault that strikes at a stamp, None where none does; note it."""
        rng = np.random.default_rng([self.seed, stamp_ns % 2**64])
        if rng.random() >= self.rate_ratio or not self.kinds or stamp_ns in self._struck:
            return None
        kind = self.kinds[int(rng.integers(len(self.kinds)))]
        self._struck.add(stamp_ns)
        line = json.dumps({"stamp_ns": stamp_ns, "kind": kind, "clock_ns": monotonic_ns()})
        with self.record.open("a") as file:
            file.write(f"{line}\n")
        return kind
