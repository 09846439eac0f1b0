"""The verbs that a queue starts, on a bench of this process: real runs, real folders, real deaths.

Usage: program.py VERB ... as `bramah` has them. What happens is the protocol's name, a mode with a
number: "done", "fail", "refuse", "trip-20", "lost-20", "die-20", "endless", "die-early", "odd",
"stopped" and "all-stopped" by `bramah stop` during the check.
Every run that gets as far as its bench appends a line to OUT.starts.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drivers.base import SampleBlock
    from tests.services.fake_driver import FakeDriver


def write_line(text: str) -> None:
    sys.stdout.write(text + "\n")


def option(name: str, default: str = "") -> str:
    words = sys.argv
    return words[words.index(name) + 1] if name in words else default


def driver(rig, mode: str, number: int) -> FakeDriver:
    from tests.services.fake_driver import FakeDriver, kill_self

    made: list[FakeDriver] = []

    def before(sequence: int) -> None:
        if sequence < number:
            return
        if mode == "die":
            kill_self()
        if mode == "lost":
            made[0].dead = True

    def spoil(block: SampleBlock) -> SampleBlock:
        if mode == "trip" and block.sequence >= number:
            data = block.data.copy()
            data[:, rig.recorded.index("cap_pressure_1")] = 50e6
            return replace(block, data=data)
        return block

    pace = 0.005 if mode == "endless" else 0.0
    log = Path(option("--out")).with_suffix(".device")
    made.append(FakeDriver(rig, before_block=before, spoil=spoil, pace=pace, log=log))
    return made[0]


def run(mode: str, number: int) -> None:
    from drivers.base import OutputLaw
    from rig.bench.session import Bench
    from rig.cli.errors import WorkError
    from rig.model.parse import InputError
    from rig.runs.recorder import Recorder
    from rig.runs.rigs import load_rig

    out = Path(option("--out"))
    if mode == "die-early":
        os.kill(os.getpid(), 9)
    if mode == "unready":
        raise InputError("the protocol was changed since: refused")
    rig = load_rig("shinshu-2dof")
    with Bench(rig, driver(rig, mode, number), Recorder(out, rig)) as bench:
        with out.with_suffix(".starts").open("a") as stream:
            stream.write(f"{os.getpid()}\n")
        bench.apply([OutputLaw(bias=1.0, limit=2.0), OutputLaw()])
        bench.exchange()
        for repeat in range(1, 100_000 if mode == "endless" else 3):
            with bench.record(step="s", repeat=repeat):
                bench.run_for(0.3)
        if mode == "fail":
            raise WorkError("the protocol could not be done")
        if mode == "odd":
            os._exit(77)


def work() -> int:
    verb, words = sys.argv[1], sys.argv[2:]
    mode, _, number = words[0].rpartition("-") if words[0][-1:].isdigit() else (words[0], "", "0")
    if verb == "check":
        if mode == "refuse":
            sys.stderr.write("bramah: step 'step1', joint 2: the piston reaches 80 mm\n")
            return 2
        if mode in ("stopped", "all-stopped"):
            from rig.bench.latch import note_stop
            from rig.runs.rigs import load_rig

            note_stop(load_rig("shinshu-2dof").wire.endpoint if mode == "stopped" else "")
        write_line(json.dumps({"ok": True, "seconds": 1.0}))
    elif verb == "run":
        from rig.cli.errors import guarded

        return guarded(lambda: run(mode, int(number)), debug=False)
    elif verb == "identify":
        spread = float(os.environ.get("TEST_STD", "0.001"))
        write_line(json.dumps({"parameters": {"b": {"value": 2.0, "std": spread, "unit": "1/s"}}}))
    elif verb == "probe":
        oil = Path(os.environ["TEST_OIL"])  # a reading a line; the last one stays
        readings = oil.read_text().split()
        degrees = float(readings[0])
        oil.write_text("\n".join(readings[1:] or readings))
        write_line(json.dumps([{"channel": "oil_temperature", "mean": degrees}]))
    elif verb == "stop":
        from rig.bench.latch import note_stop
        from rig.runs.rigs import load_rig

        note_stop(load_rig("shinshu-2dof").wire.endpoint)
        write_line("outputs at zero, confirmed by the device")
    elif verb == "recover":
        from rig.cli.main import command_line

        command_line(["recover"])(["recover", *words], standalone_mode=False)
    return 0


if __name__ == "__main__":
    sys.exit(work())
