"""The errors of SceneSLAM; each message is one sentence that a user can act on."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

_log = logging.getLogger(__name__)
_SHOWN = 400  # characters of a value in a message


class SceneSlamError(Exception):
    """Root of all errors that SceneSLAM raises on purpose."""


class InputError(SceneSlamError):
    """A recording, file or sensor stream is invalid."""


class ConfigError(SceneSlamError):
    """A configuration key is unknown, missing or has a value that is not allowed."""

    def __init__(self, key: str, value: object, allowed: str) -> None:
        super().__init__(key, value, allowed)
        self.key, self.value, self.allowed = key, value, allowed

    def __str__(self) -> str:
        got = repr(self.value)
        got = got if len(got) <= _SHOWN else f"{got[:_SHOWN]}..."
        return f"{self.key}: got {got}, allowed: {self.allowed}"

    def under(self, prefix: str) -> ConfigError:
        """Return the same error with its key below `prefix` (`policy` + `confirm_window_s`)."""
        return ConfigError(f"{prefix}.{self.key}" if self.key else prefix, self.value, self.allowed)


class ModuleError(SceneSlamError):
    """A SLAM module or detector violated its contract and was stopped."""


def text_of(error: BaseException) -> str:
    """Return the error's type and message on one line."""
    kind = type(error).__name__
    try:
        said = str(error)
    except Exception:
        return kind
    said = " ".join(filter(None, map(str.strip, said.splitlines())))
    return f"{kind}: {said}" if said else kind


@contextmanager
def calling(what: str, kind: type[SceneSlamError] = ModuleError) -> Iterator[None]:
    """Raise any exception of a plug-in, which is called within, as `kind`; Ctrl-C passes."""
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        sentence = f"{what}: {text_of(error)}"
        _log.info(sentence, exc_info=error)
        raise kind(sentence) from error
