"""Messages between the main process and a module's process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A call of one of the module's methods; the first request builds the module."""

    number: int
    method: str
    arguments: tuple[Any, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LogLine:
    """A log record of the module during a call."""

    logger: str
    level: int
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """The result of a request."""

    number: int
    value: Any = None
    error: Exception | None = None
    traceback: str = ""
    log: tuple[LogLine, ...] = ()
