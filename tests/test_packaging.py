"""The package as it is installed: nothing is left out of a wheel."""

import tomllib
from pathlib import Path

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


def test_conf_and_modules_are_reachable_under_one_name():
    import sceneslam.conf
    import sceneslam.modules.detectors.grey_mean

    assert sceneslam.modules.detectors.grey_mean.__name__.startswith("sceneslam.modules")
