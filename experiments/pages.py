"""Keep the tables of the pages equal to the files that they come from.

python experiments/pages.py          # write every table anew from its CSV
python experiments/pages.py --adopt  # first write a CSV for tables that have none yet

A table of a page lies between `<!-- FILE.csv -->` and `<!-- end -->`. FILE is the `table.csv` that
an experiment wrote, or what a script printed; its path is below `experiments/`.
"""

from __future__ import annotations

import argparse
import csv
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EXPERIMENTS = ROOT / "experiments"
_BLOCK = re.compile(r"<!-- (?P<file>\S+\.csv) -->\n(?P<table>.*?)<!-- end -->\n", re.S)
_TABLE = re.compile(r"(?:^\|.*\|\n)+", re.M)
_NUMBER = re.compile(r"[-+±~<>]?\s?\d")
_RULE = re.compile(r"\|[\s:|-]+\|")


def pages() -> list[Path]:
    """Return the pages whose tables hold measurements."""
    found = sorted(EXPERIMENTS.rglob("*.md"))
    fixed = [ROOT / "README.md", ROOT / "docs" / "modules.md"]
    return [*fixed, *(page for page in found if "results" not in page.parts)]


def written_anew(text: str) -> str:
    """Return a page with every marked table as its CSV has it."""
    return _BLOCK.sub(lambda block: _block(block["file"]), text)


def unmarked(text: str) -> Iterator[str]:
    """Yield the tables of a page that hold numbers and name no file."""
    for table in _TABLE.findall(_BLOCK.sub("", text)):
        if any(_NUMBER.match(cell) for row in _rows(table)[1:] for cell in row[1:]):
            yield table


def adopted(text: str, folder: str) -> str:
    """Return a page with its unmarked tables marked; write a CSV for each into a folder."""
    for table in list(unmarked(text)):
        taken = (int(path.stem) for path in (EXPERIMENTS / folder).glob("[0-9]*.csv"))
        name = f"{folder}/{max(taken, default=0) + 1}.csv"
        (EXPERIMENTS / folder).mkdir(parents=True, exist_ok=True)
        with (EXPERIMENTS / name).open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(_rows(table))
        text = text.replace(table, _block(name))
    return text


def _block(name: str) -> str:
    with (EXPERIMENTS / name).open(newline="") as file:
        rows = list(csv.reader(file))
    body = [[row[0], *map(_shown, row[1:])] for row in rows[1:]]
    lines = [rows[0], ["---"] * len(rows[0]), *body]
    table = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    return f"<!-- {name} -->\n{table}<!-- end -->\n"


def _shown(cell: str) -> str:
    """Return a cell as a person reads it: of a long number four digits."""
    if re.fullmatch(r"-?\d*\.\d{4,}(e-?\d+)?|nan", cell) is None:
        return cell or "-"
    value = float(cell)
    return "-" if value != value else f"{value:.4g}"


def _rows(table: str) -> list[list[str]]:
    lines = [line for line in table.splitlines() if not _RULE.fullmatch(line)]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Write the tables of the pages from their files.")
    parser.add_argument("--adopt", action="store_true", help="write files for tables without one")
    options = parser.parse_args(arguments)
    for page in pages():
        text = page.read_text()
        name = page.relative_to(ROOT).with_suffix("").as_posix().removeprefix("experiments/")
        new = written_anew(adopted(text, f"results/{name}") if options.adopt else text)
        if new != text:
            page.write_text(new)
            print(page.relative_to(ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main())
