"""What the bus's process and a module's process say to each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A call of one of the module's methods; the first is the word to build it."""

    number: int
    method: str
    arguments: tuple[Any, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LogLine:
    """What a module said in the log during a call."""

    logger: str
    level: int
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What came of a request."""

    number: int
    value: Any = None
    error: Exception | None = None
    traceback: str = ""
    log: tuple[LogLine, ...] = ()
