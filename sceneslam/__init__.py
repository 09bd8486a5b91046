"""SceneSLAM: run the SLAM module that suits the scene, keep one trajectory and one map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sceneslam.app import Finished

__version__ = "0.1.0"
__all__ = ["__version__", "run"]

# In a checkout, `conf`, `modules` and `experiments` are beside this package, in a wheel inside it:
# in both cases they are `sceneslam.conf`, `sceneslam.modules` and `sceneslam.experiments`.
_CHECKOUT = Path(__file__).resolve().parent.parent
if (_CHECKOUT / "pyproject.toml").is_file() and (_CHECKOUT / "modules" / "slam").is_dir():
    __path__.append(str(_CHECKOUT))


def run(
    *overrides: str, folder: str | Path | None = None, config_dir: str | Path | None = None
) -> Finished:
    """Run a configuration as the command line does; see `sceneslam.script.run`."""
    from sceneslam import script  # libraries are loaded when needed

    return script.run(*overrides, folder=folder, config_dir=config_dir)
