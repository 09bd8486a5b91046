"""Write a self-contained HTML file from a template and the common style."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from string import Template

from sceneslam.types.files import replacing


def fill_page(path: Path, package: str, template: str, values: Mapping[str, str]) -> Path:
    """Fill a package's template, including the style; return the page's path."""
    page = Template(files(package).joinpath(template).read_text("utf-8"))
    style = files("sceneslam.evaluation.report").joinpath("page.css").read_text("utf-8")
    with replacing(path, encoding="utf-8") as file:
        file.write(page.substitute(values, style=style))
    return path
