"""Conversion of composed configurations to plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

from hydra import compose
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sceneslam.types.errors import ConfigError


def composed(overrides: Sequence[str]) -> dict[str, Any]:
    """Return the configuration of a command line, with unresolved `${...}`."""
    config = compose("config", overrides=list(overrides))
    return cast("dict[str, Any]", OmegaConf.to_container(config, resolve=False))


def resolved(config: DictConfig | Mapping[str, Any]) -> dict[str, Any]:
    """Return the configuration as plain values; raises ConfigError for an invalid `${...}`."""
    try:
        whole = config if isinstance(config, DictConfig) else OmegaConf.create(dict(config))
        plain = OmegaConf.to_container(whole, resolve=True, throw_on_missing=False)
    except OmegaConfBaseException as error:
        key = str(getattr(error, "full_key", "") or "configuration")
        reason = str(error).splitlines()[0]
        raise ConfigError(key, "an interpolation", f"one that resolves ({reason})") from error
    return cast("dict[str, Any]", plain)


def without_hydra(config: DictConfig) -> DictConfig:
    """Return the configuration without Hydra's own part."""
    return OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
