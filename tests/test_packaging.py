"""The package as it is installed: nothing is left out of a wheel."""

import os
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_every_package_is_listed_for_the_wheel():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    found = {"sceneslam.conf"}
    for top in ("sceneslam", "modules", "experiments"):
        for init in (ROOT / top).rglob("__init__.py"):
            name = ".".join(init.parent.relative_to(ROOT).parts)
            found.add(name if top == "sceneslam" else f"sceneslam.{name}")
    assert set(listed) == found


def test_every_folder_with_code_is_a_package():
    for top in ("sceneslam", "modules", "experiments"):
        for path in (ROOT / top).rglob("*.py"):
            assert (path.parent / "__init__.py").exists(), path


@pytest.mark.parametrize(
    ("version", "is_taken"), [(10, False), (11, True), (13, True), (14, False)]
)
def test_setup_takes_the_versions_of_python_that_pip_takes(tmp_path, version, is_taken):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["requires-python"] == ">=3.11,<3.14"
    tools, script = tmp_path / "tools", tmp_path / ".ci" / "setup"
    tools.mkdir()
    script.parent.mkdir()
    shutil.copy(ROOT / ".ci" / "setup", script)
    (tools / "dirname").symlink_to(str(shutil.which("dirname")))
    words = f"import sys; sys.version_info = (3, {version}, 0); exec(sys.argv[-1])"
    asked = f'exec {shlex.quote(sys.executable)} -c {shlex.quote(words)} "$@"'
    (tools / "python3").write_text(f"#!{shutil.which('sh')}\n{asked}\n")
    (tools / "python3").chmod(0o755)
    done = subprocess.run(
        [str(shutil.which("bash")), str(script), "typo"],
        env={name: value for name, value in os.environ.items() if name != "PYTHON"}
        | {"PATH": str(tools)},
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0
    assert ("SceneSLAM needs Python 3.11, 3.12 or 3.13" in done.stderr) is not is_taken


def test_conf_and_modules_are_reachable_under_one_name():
    import sceneslam.conf
    import sceneslam.modules.detectors.grey_mean

    assert sceneslam.modules.detectors.grey_mean.__name__.startswith("sceneslam.modules")
