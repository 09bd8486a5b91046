"""A robot for the tests, of another vendor's DDS: run by a Python that has rclpy.

    python robot.py RECORDING.mcap HEARD.json [PLAN.json]

Plays a recording's sensor topics at the pace of their stamps, as if measured now, and writes down
what it hears of a run: poses, transforms, path, map, scenes and modules. The plan may set a `rate`
(0.25: a quarter of the robot's speed) and list what goes wrong and what is said (see `player`).
"""

import json
import multiprocessing
import pathlib
import sys

from listener import listen
from player import play


def main(recording, heard_path, plan_path=None):
    plan = json.loads(pathlib.Path(plan_path).read_text()) if plan_path else {}
    # Two processes: receiving and converting a message takes Python milliseconds, in which a robot
    # of one process would publish late.
    spawn = multiprocessing.get_context("spawn")
    is_over = spawn.Event()
    listener = spawn.Process(target=listen, args=(heard_path, is_over))
    listener.start()
    played = play(recording, plan)
    is_over.set()
    listener.join()
    heard = json.loads(pathlib.Path(heard_path).read_text())
    pathlib.Path(heard_path).write_text(json.dumps(heard | played))


if __name__ == "__main__":
    main(*sys.argv[1:])
