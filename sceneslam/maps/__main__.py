"""Inspect and edit saved maps: `python -m sceneslam.maps info|check|merge|prune|export MAP`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from sceneslam.atlas.lasting.map_files import (
    HEAD,
    check_map_folder,
    load_map_files,
    save_map_files,
    seal_of,
)
from sceneslam.atlas.lasting.merge import join_pieces, side_by_side
from sceneslam.atlas.lasting.prune import prune
from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.maps.export import export
from sceneslam.maps.inspect import described, flaws
from sceneslam.storage.folder import RunFolder
from sceneslam.streams import secure_streams
from sceneslam.types.errors import InputError, SceneSlamError, text_of

OK, INCOMPLETE, UNUSABLE = 0, 1, 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 if something is wrong or left out, 2 if it is not a map."""
    options = _parser().parse_args(arguments)
    try:
        return int(options.act(options))
    except (SceneSlamError, OSError) as error:
        said = str(error) if isinstance(error, SceneSlamError) else text_of(error)
        print(f"error: {said}", file=sys.stderr)
        return UNUSABLE


def _info(options: argparse.Namespace) -> int:
    print("\n".join(described(load_map_files(options.map))))
    return OK


def _check(options: argparse.Namespace) -> int:
    found = flaws(load_map_files(options.map))
    for flaw in found:
        print(f"error: {flaw}", file=sys.stderr)
    if not found:
        print("the map has no errors")
    return INCOMPLETE if found else OK


def _merge(options: argparse.Namespace) -> int:
    check_map_folder(options.out)
    saved = load_map_files(options.map)
    for folder in options.others:
        other = load_map_files(folder)
        if _measured(saved) & _measured(other):
            raise InputError(
                f"each measurement is merged once, one before has submaps of this map: {folder}"
            )
        saved = side_by_side(saved, other)
    joined = join_pieces(saved)
    lines = described(joined)  # fails if a piece is too large, before anything is written
    save_map_files(joined, options.out)
    print("\n".join([*lines, f"map  {options.out}"]))
    if joined.apart:
        print(
            f"error: pieces that were not recognized in another and stay apart: {joined.apart}",
            file=sys.stderr,
        )
    return INCOMPLETE if joined.apart else OK


def _measured(saved: SavedMap) -> set[tuple[bytes, bytes]]:
    """Return stamps and poses of each submap, which no later run changes.

    One pose alone may be that of another run: both have the stamp 0 in the simulator.
    """
    return {
        (submap.stamps_ns.tobytes(), submap.T_submap_base.tobytes())
        for submap in saved.submaps
        if len(submap.stamps_ns) > 1
    }


def _prune(options: argparse.Namespace) -> int:
    check_map_folder(options.out)
    saved = load_map_files(options.map)
    thinned = prune(saved)
    save_map_files(thinned, options.out)
    print(f"{len(saved.submaps)} submaps, {len(thinned.submaps)} kept")
    print(f"map  {options.out}")
    return OK


def _export(options: argparse.Namespace) -> int:
    if (options.out / HEAD).exists() or seal_of(options.out.absolute().parent) is not None:
        raise InputError(f"a map is saved in a folder of its own, choose another: {options.out}")
    saved = load_map_files(options.map)
    saved.check_size()
    with closing(RunFolder.claim(options.out, kind="map's export", key="--out")) as folder:
        folder.clear()
        for path in export(saved, options.out):
            print(path)
    if saved.apart:
        print(
            f"error: pieces beside the first, which are not exported: {saved.apart}",
            file=sys.stderr,
        )
    return INCOMPLETE if saved.apart else OK


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sceneslam.maps", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="info|check|merge|prune|export")
    for name, act, about in (
        ("info", _info, "describe a map"),
        ("check", _check, "check a map for errors"),
        ("merge", _merge, "join maps, and the pieces of one, where they show the same place"),
        ("prune", _prune, "drop submaps whose ground later ones show as well"),
        ("export", _export, "write the grid for map_server and the graph as g2o"),
    ):
        command = commands.add_parser(name, help=about, description=about)
        command.add_argument("map", type=Path, help="the folder of a saved map")
        command.set_defaults(act=act)
        if name == "merge":
            command.add_argument("others", type=Path, nargs="*", help="more maps")
        if name in ("merge", "prune", "export"):
            command.add_argument(
                "--out", type=Path, required=True, metavar="FOLDER", help="where the result goes"
            )
    return parser


if __name__ == "__main__":
    secure_streams()
    sys.exit(main())
