"""A process that publishes the recorded run over the real local sockets, to look at the screen:

python -m tests.tui.fake_run [--trip 8] [--silent 12] [--die 15] [--joints 2] [--speed 1]

`--trip`, `--silent`, `--die` are device times [s]; it takes "stop" as a run does, then ends.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace

from rig.bench.screens.sockets import Publisher
from tests.tui.recorded import Bench, of_this_process, snapshot, stopped, tripped

PERIOD = 0.05  # wall seconds between snapshots


def main(arguments: list[str]) -> None:
    """Publish until the recorded run is over, something was asked for, or it trips."""
    parser = argparse.ArgumentParser()
    for name in ("trip", "silent", "die", "deaf"):
        parser.add_argument(f"--{name}", type=float)
    parser.add_argument("--joints", type=int, default=2)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--total", type=float, default=40.0)
    parser.add_argument("--rig", default="shinshu-2dof")
    asked = parser.parse_args(arguments)
    bench = of_this_process(
        Bench(joints=asked.joints, total=asked.total, spike=asked.trip, rig=asked.rig)
    )
    publisher = Publisher(asked.rig)
    step = PERIOD * asked.speed
    try:
        k = 0
        started = time.monotonic()
        while k * step < asked.total:
            k += 1
            view = snapshot(bench, k, step)
            now = view.device_time
            time.sleep(max(started + k * PERIOD - time.monotonic(), 0.0))
            view = replace(view, wall_time=time.time())
            deaf = asked.deaf is not None and now >= asked.deaf
            if not deaf and any(c.word == "stop" for c in publisher.commands()):
                publisher.publish(stopped(view))
                return
            if asked.trip is not None and now >= asked.trip:
                publisher.publish(tripped(view))
                return
            if asked.die is not None and now >= asked.die:
                return
            if asked.silent is None or now < asked.silent:
                publisher.publish(view)
        publisher.publish(replace(view, state="done", message="all steps done", done_s=now))
    finally:
        publisher.close()


if __name__ == "__main__":
    main(sys.argv[1:])
