"""Draw `docs/architecture.png`: the packages in layers, with an arrow to what each imports.

    python experiments/architecture_picture.py

What is imported through another package is left out, so that the arrows stay few; so are single
files that anybody may use (streams, say).
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1]
COLORS = {"sceneslam": "#d9e8f5", "modules": "#f7dcc8", "experiments": "#d8efe4"}
APP = ("app", "loop", "keeping", "results", "experiment")  # files that carry a run out: one box
SINGLE = ("interfaces", "cli", "script")  # files with a box of their own
WIDTH_IN, LAYER_IN = 10.0, 0.95
BENDS = sorted(np.linspace(-0.4, 0.4, 17), key=abs)  # of arrows, the straightest first
Imports = Mapping[str, set[str]]  # package -> the packages that it imports


def packages() -> dict[str, list[Path]]:
    """Return the source files of each box."""
    found: dict[str, list[Path]] = {
        name: sorted((ROOT / name).rglob("*.py")) for name in ("modules", "experiments")
    }
    for path in sorted((ROOT / "sceneslam").iterdir()):
        if path.is_dir() and (path / "__init__.py").is_file():
            found[path.name] = sorted(path.rglob("*.py"))
    found |= {name: [ROOT / "sceneslam" / f"{name}.py"] for name in SINGLE}
    return found | {"app": [ROOT / "sceneslam" / f"{name}.py" for name in APP]}


def imports() -> dict[str, set[str]]:
    """Return what each package imports of ours."""
    known = packages()
    return {
        package: {name for path in files for name in _imported(path)} & set(known) - {package}
        for package, files in known.items()
    }


def _imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            is_top = node.module == "sceneslam"
            names = [f"sceneslam.{one.name}" for one in node.names] if is_top else [node.module]
        elif isinstance(node, ast.Import):
            names = [one.name for one in node.names]
        for name in names:
            if name.startswith("sceneslam."):
                top = name.split(".")[1]
                yield "app" if top in APP else top


def layers(found: Imports) -> dict[str, int]:
    """Return each package's layer: one above the highest that it imports."""
    height: dict[str, int] = {}

    def visit(package: str, above: tuple[str, ...]) -> int:
        if package in above:  # a circle between single files; packages have none
            return 0
        if package not in height:
            below = [visit(one, (*above, package)) for one in sorted(found[package])]
            height[package] = 1 + max(below, default=-1)
        return height[package]

    for package in sorted(found):
        visit(package, ())
    return height


def direct(found: Imports, height: Mapping[str, int]) -> list[tuple[str, str]]:
    """Return the arrows that no chain of others replaces."""

    def reached(package: str) -> set[str]:
        lower = {one for one in found[package] if height[one] < height[package]}
        return lower.union(*(reached(one) for one in lower)) if lower else set()

    arrows = []
    for package in sorted(found):
        lower = {one for one in found[package] if height[one] < height[package]}
        indirect = set().union(*(reached(one) for one in lower)) if lower else set()
        arrows += [(package, one) for one in sorted(lower - indirect)]
    return arrows


def bend(package: str, other: str, place: Mapping[str, tuple[float, float]]) -> float:
    """Return the bend of an arrow (matplotlib's arc3) that hides least of it behind boxes."""
    gap = np.array([0.0, 0.19])
    start, end = place[package] - gap, place[other] + gap
    share = np.linspace(0.0, 1.0, 50)[:, np.newaxis]
    boxes = [(np.array(at), 0.2 + 0.05 * len(one)) for one, at in place.items()]  # half as wide

    def hidden(rad: float) -> int:
        middle = (start + end) / 2 + rad * np.array([1.0, -1.0]) * (end - start)[::-1]
        line = (1 - share) ** 2 * start + 2 * share * (1 - share) * middle + share**2 * end
        off = [np.abs(line - at) < (half, 0.18) for at, half in boxes]
        return sum(int(np.all(one, axis=1).sum()) for one in off)

    return float(min(BENDS, key=hidden))


def draw(path: Path) -> None:
    """Write the picture."""
    found = imports()
    height = layers(found)
    count = max(height.values()) + 1
    rows = [[one for one in sorted(height) if height[one] == row] for row in range(count)]
    arrows = direct(found, height)
    place: dict[str, tuple[float, float]] = {}
    for number, row in enumerate(rows):
        below = {p: [place[other][0] for one, other in arrows if one == p] for p in row}
        middle = {p: sum(at) / len(at) if at else WIDTH_IN / 2 for p, at in below.items()}
        for column, package in enumerate(sorted(row, key=lambda p: (middle[p], p))):
            place[package] = (WIDTH_IN * (column + 0.5) / len(row), LAYER_IN * number)
    figure = Figure(figsize=(WIDTH_IN, LAYER_IN * len(rows)), layout="tight")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for package, other in arrows:
        axes.annotate(
            "",
            xy=(place[other][0], place[other][1] + 0.19),
            xytext=(place[package][0], place[package][1] - 0.19),
            arrowprops={
                "arrowstyle": "-|>",
                "color": "#9aa0a6",
                "linewidth": 1.0,
                "connectionstyle": f"arc3,rad={bend(package, other, place)}",
            },
            zorder=1,
        )
    for package, (x, y) in place.items():
        color = COLORS.get(package, COLORS["sceneslam"])
        box = {"boxstyle": "round,pad=0.35", "facecolor": color, "edgecolor": "#5b6168"}
        axes.text(x, y, package, ha="center", va="center", fontsize=11, bbox=box, zorder=2)
    axes.set_xlim(0, WIDTH_IN)
    axes.set_ylim(-0.5, LAYER_IN * (len(rows) - 1) + 0.5)
    axes.axis("off")
    figure.savefig(path, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    draw(ROOT / "docs" / "architecture.png")
