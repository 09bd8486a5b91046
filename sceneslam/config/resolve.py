"""A composed configuration as plain values."""

from __future__ import annotations

from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sceneslam.types.errors import ConfigError


def resolved(config: DictConfig) -> dict[str, Any]:
    """Return the configuration as plain values; raises ConfigError for a dead interpolation."""
    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    except OmegaConfBaseException as error:
        key = str(getattr(error, "full_key", "") or "configuration")
        reason = str(error).splitlines()[0]
        raise ConfigError(key, "an interpolation", f"one that resolves ({reason})") from error
    return cast("dict[str, Any]", plain)
