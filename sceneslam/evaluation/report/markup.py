"""HTML elements of the pages. All text that is passed in is escaped."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from urllib.parse import quote


class Markup(str):
    """Text that is already HTML and is not escaped again."""

    __slots__ = ()


def link(path: str, text: str) -> Markup:
    """Return a link to a file beside the page."""
    return Markup(f'<a href="{escape(quote(path))}">{escape(text)}</a>')


def paragraphs(sentences: Iterable[str]) -> str:
    """Return a paragraph per text."""
    return "".join(f"<p>{escape(sentence)}</p>\n" for sentence in sentences)


def tiles(numbers: Mapping[str, str]) -> str:
    """Return numbers with their names as tiles; unknown numbers (a dash) are left out."""
    items = "".join(
        f"<li><b>{escape(value)}</b><span>{escape(name)}</span></li>"
        for name, value in numbers.items()
        if value != "–"
    )
    return f'<ul class="numbers">{items}</ul>'


def bullets(sentences: Iterable[str]) -> str:
    """Return an unordered list."""
    return f"<ul>{''.join(f'<li>{escape(sentence)}</li>' for sentence in sentences)}</ul>"


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table that scrolls by itself where the page is too narrow for it."""
    head = "".join(f"<th>{_escaped(name)}</th>" for name in heads)
    body = "".join(
        f"<tr>{''.join(f'<td>{_escaped(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    whole = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll">{whole}</div>'


def figure(svg: str, caption: str) -> str:
    """Return a figure from an SVG element that is safe, with its caption."""
    label = escape(caption)
    labelled = svg.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)
    return f"<figure>{labelled}<figcaption>{label}</figcaption></figure>\n"


def picture(image: bytes, caption: str, kind: str = "png") -> str:
    """Return a figure from the bytes of a PNG or JPEG file, with its caption."""
    label, data = escape(caption), b64encode(image).decode("ascii")
    element = f'<img alt="{label}" src="data:image/{kind};base64,{data}">'
    return f"<figure>{element}<figcaption>{label}</figcaption></figure>\n"


def _escaped(cell: object) -> str:
    return cell if isinstance(cell, Markup) else escape(str(cell))
