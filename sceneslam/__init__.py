"""SceneSLAM: run the SLAM module that suits the scene, keep one trajectory and one map."""

from pathlib import Path

__version__ = "0.1.0"

# In a checkout `conf`, `modules` and `experiments` lie beside this package, in a wheel inside it:
# either way they are `sceneslam.conf`, `sceneslam.modules` and `sceneslam.experiments`.
_CHECKOUT = Path(__file__).resolve().parent.parent
if (_CHECKOUT / "pyproject.toml").is_file() and (_CHECKOUT / "modules" / "slam").is_dir():
    __path__.append(str(_CHECKOUT))
