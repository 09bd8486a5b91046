"""Make a coloured mesh of a finished run: `python -m sceneslam.mesh RUN`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from sceneslam.config.words import named_targets
from sceneslam.mesh.mesh import write_mesh
from sceneslam.streams import secure_streams
from sceneslam.types.errors import ConfigError, SceneSlamError, text_of

_VOXEL_M = 0.03


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the mesh; return the exit code: 0 it is written, 2 the run cannot be read."""
    options = _parser().parse_args(arguments)
    try:
        if not 0.002 <= options.voxel_m <= 1.0:
            raise ConfigError("--voxel-m", options.voxel_m, "0.002 to 1 m")
        allowed = named_targets(options.allowed, "mesh", "RUN, --voxel-m")
        meshed = write_mesh(options.run.resolve(), options.voxel_m, allowed)
    except (SceneSlamError, OSError) as error:
        said = str(error) if isinstance(error, SceneSlamError) else text_of(error)
        print(f"error: {said}", file=sys.stderr)
        return 2
    print(f"mesh     {meshed.path}: {meshed.triangles} triangles of {meshed.views} depth images")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sceneslam.mesh", description=__doc__)
    parser.add_argument("run", type=Path, help="the folder of a finished run with depth images")
    parser.add_argument(
        "--voxel-m", type=float, default=_VOXEL_M, help=f"size of a voxel [m] ({_VOXEL_M})"
    )
    parser.add_argument(
        "allowed",
        nargs="?",
        metavar="allow_targets=[NAME]",
        help="packages of your own that hold the run's source",
    )
    return parser


if __name__ == "__main__":
    secure_streams()
    sys.exit(main())
