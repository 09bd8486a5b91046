"""Score trajectory files: `python -m sceneslam.evaluation ate|relations ...`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from sceneslam.evaluation.accuracy import absolute_errors, relative_errors, root_mean_square
from sceneslam.evaluation.files import has_stamps, read_poses
from sceneslam.evaluation.relations import Relations, relation_errors
from sceneslam.streams import secure_streams
from sceneslam.types.errors import ConfigError, InputError, SceneSlamError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code (2 for input that cannot be used)."""
    options = _parser().parse_args(arguments)
    try:
        scores = _ate(options) if options.command == "ate" else _relations(options)
    except SceneSlamError as err:
        print(f"error: {err}", file=sys.stderr)
        return 2
    print(json.dumps(scores, indent=2))
    return 0


def _ate(options: argparse.Namespace) -> dict[str, float | int | None]:
    if not 0 <= options.max_gap_s <= 1e9:
        raise ConfigError("--max-gap-s", options.max_gap_s, "0 to 1e9 [s]")
    estimate, truth = read_poses(options.estimate), read_poses(options.truth)
    if has_stamps(options.estimate) != has_stamps(options.truth):
        raise InputError(
            "one file has stamps (TUM layout), the other has none (KITTI layout); score against "
            f"the groundtruth.tum of the run: {options.estimate}, {options.truth}"
        )
    absolute = absolute_errors(estimate, truth, options.max_gap_s)
    if not len(absolute.errors_m):
        raise InputError(
            f"no poses within {options.max_gap_s:g} s of each other: "
            f"{options.estimate}, {options.truth}"
        )
    relative = relative_errors(estimate, truth, options.max_gap_s, 1.0)
    has_pairs = len(relative.trans_m) > 0
    return {
        "ate_rmse_m": absolute.rmse_m,
        "ate_max_m": absolute.max_m,
        "rpe_trans_m": root_mean_square(relative.trans_m) if has_pairs else None,
        "rpe_rot_rad": root_mean_square(relative.rot_rad) if has_pairs else None,
        "matched": len(absolute.errors_m),
        "total": len(estimate),
    }


def _relations(options: argparse.Namespace) -> dict[str, float | int]:
    return relation_errors(read_poses(options.trajectory), Relations.read(options.relations))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sceneslam.evaluation", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    ate = commands.add_parser(
        "ate",
        help="absolute and relative error against a true trajectory",
        description="Both files have to hold poses of the same body frame: else the relative "
        "error is wrong. trajectory.tum of a run holds those of `base`, and so does its "
        "groundtruth.tum; the ground truth of TUM's recordings is of the camera's optical frame.",
    )
    ate.add_argument("estimate", type=Path, help="TUM or KITTI file")
    ate.add_argument("truth", type=Path, help="the same layout, true poses")
    ate.add_argument(
        "--max-gap-s", type=float, default=0.01, help="poses further apart do not match (0.01)"
    )
    relations = commands.add_parser("relations", help="error of relative poses (Kuemmerle et al.)")
    relations.add_argument("trajectory", type=Path, help="TUM file")
    relations.add_argument("relations", type=Path, help="lines `t1 t2 x y z roll pitch yaw`")
    return parser


if __name__ == "__main__":
    secure_streams()
    sys.exit(main())
