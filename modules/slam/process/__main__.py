"""Build an included C++ program: `python -m sceneslam.modules.slam.process NAME OUT`.

Without arguments it prints the folder of the header `sceneslam.hpp`, for a compiler's `-I`.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from sceneslam.types.errors import ConfigError, ModuleError, SceneSlamError

FOLDER = Path(__file__).with_name("cpp")
_LIBRARIES = {
    "wheels": (),
    "mrpt_rbpf": ("slam", "maps", "obs", "poses", "bayes", "random", "rtti", "math", "core"),
}
_PREFIXES = (Path("/usr/include"), Path("/usr/local/include"))


def build(name: str, out: Path) -> None:
    """Compile a program; raises ConfigError or ModuleError that says what is missing."""
    if name not in _LIBRARIES:
        raise ConfigError("NAME", name, " | ".join(_LIBRARIES))
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        raise ModuleError("no C++ compiler: none of c++, g++, clang++ is in PATH")
    flags = _mrpt_flags(_LIBRARIES[name]) if _LIBRARIES[name] else []
    command = [compiler, "-std=c++17", "-O2", "-I", str(FOLDER), str(FOLDER / f"{name}.cpp")]
    done = subprocess.run([*command, "-o", str(out), *flags], capture_output=True, text=True)
    if done.returncode != 0:
        raise ModuleError(f"{name}.cpp does not compile:\n{done.stderr.strip()}")


def _mrpt_flags(libraries: tuple[str, ...]) -> list[str]:
    """Return compiler flags for MRPT, which has no pkg-config files."""
    headers = [path for prefix in _PREFIXES for path in sorted(prefix.glob("mrpt/*/include"))]
    if not headers:
        raise ModuleError("MRPT is missing: install libmrpt-dev, as it is called on Debian")
    eigen = [prefix / "eigen3" for prefix in _PREFIXES]
    includes = [f"-isystem{path}" for path in (*headers, *eigen)]
    return [*includes, *[f"-lmrpt-{library}" for library in libraries]]


def main(arguments: list[str]) -> int:
    """Return the exit code."""
    if not arguments:
        sys.stdout.write(f"{FOLDER}\n")
        return 0
    if len(arguments) != 2:
        sys.stderr.write(f"{__doc__}\n")
        return 2
    try:
        build(arguments[0], Path(arguments[1]))
    except SceneSlamError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
