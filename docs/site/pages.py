"""What MkDocs is told besides `docs/`: README.md, the experiments' pages, and the reference."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import reference

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
_LINK = re.compile(r"(?P<bang>!?)\[(?P<text>[^\]]*)\]\((?P<target>[^)\s]+)\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the generated pages to the navigation."""
    nav: list[Any] = list(config.nav or [])
    nav.append({"Reference": [f"reference/{name}" for name in reference.pages()]})
    nav.append({"Experiments": [to for path, to in _borrowed().items() if _is_experiment(path)]})
    config.nav = nav
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that do not lie in `docs/`, and the pictures that they show."""
    from mkdocs.structure.files import File

    for name, text in reference.pages().items():
        files.append(File.generated(config, f"reference/{name}", content=text))
    for path, to in _borrowed().items():
        files.append(File.generated(config, to, content=(ROOT / path).read_text()))
    for picture in sorted((ROOT / "experiments").rglob("*.png")):
        to = picture.relative_to(ROOT).as_posix()
        files.append(File.generated(config, to, content=picture.read_bytes()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let links between files of the repository be links between pages.

    A link to a file that is no page, such as a program, becomes its text.
    """
    to = page.file.src_uri
    lies_at = {site: path for path, site in _borrowed().items()}.get(to, f"docs/{to}")

    def relink(match: re.Match[str]) -> str:
        target, _, anchor = match["target"].partition("#")
        if not target or "://" in target:
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(lies_at), target))
        site = _borrowed().get(path, path.removeprefix("docs/"))
        if files.get_file_from_path(site) is None:
            return match[0] if (ROOT / "docs" / site).suffix == ".md" else match["text"]
        link = posixpath.relpath(site, posixpath.dirname(to) or ".")
        return f"{match['bang']}[{match['text']}]({link}{'#' + anchor if anchor else ''})"

    return markdown if to.startswith("reference/") else _LINK.sub(relink, markdown)


def _borrowed() -> dict[str, str]:
    """Return the pages outside `docs/`: path in the repository -> path on the site."""
    found = {"README.md": "index.md"}
    for path in sorted((ROOT / "experiments").rglob("*.md")):
        name = path.relative_to(ROOT).as_posix()
        found[name] = name.replace("/README.md", ".md")
    return found


def _is_experiment(path: str) -> bool:
    return path.startswith("experiments/") and "/results/" not in path  # tables alone
