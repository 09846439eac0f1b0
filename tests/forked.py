"""Programs as processes of their own, forked from one that has imported what they need.

A fresh process takes one to two seconds of the processor to import what a bench or a run needs,
which is most of what a short test takes. A forked one has its own session, standard streams,
working folder, environment and signals like one started anew; it is killed and waited for like one.
What a start itself does is tested with real starts: `tests/cli/test_startup.py`.

    python -m tests.forked NUMBER     serves the requests that come over an inherited socket
"""

from __future__ import annotations

import atexit
import gc
import io
import json
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from runpy import run_module
from typing import Any, Final, TextIO

ROOT: Final = Path(__file__).parents[1]
LENGTH: Final = 8  # bytes of a request's length, of a number of a process and of an exit code
ADDRESS: Final = "BRAMAH_TESTS_FORK"  # environment variable: where the process to fork from listens
STREAMS: Final = 3  # standard output, standard error, status
MOST: Final = 8  # open files sent with a request: these streams, and what is inherited
COMMAND: Final = "rig.cli.main"
IMPORTED: Final = (
    "rig.cli.verbs.run", "rig.cli.verbs.sim", "rig.cli.execution.protocol_run", "rig.bench.session",
    "hil_sim.device.server",
)  # fmt: skip


class Forked:
    """A forked process of `bramah` or of a module, as `subprocess.Popen` has one.

    Its output is text in pipes; `told` leaves its errors where this process has its own. With
    `files`, numbers of open files, they are its standard output and error. It also has the open
    files `inherited` until it ends.
    """

    def __init__(
        self,
        words: Sequence[object],
        cwd: Path | None = None,
        module: str = COMMAND,
        *,
        told: bool = False,
        files: tuple[int, int] | None = None,
        inherited: Sequence[int] = (),
    ) -> None:
        self.args = [str(word) for word in words]
        self.returncode: int | None = None
        self._status, status = socket.socketpair()
        ends = [] if files else [os.pipe(), os.pipe()]
        request = {
            "module": module, "words": self.args, "cwd": str(cwd or Path.cwd()),
            "environment": {**os.environ},
        }  # fmt: skip
        outputs = files or (ends[0][1], 2 if told else ends[1][1])
        _ask(request, [*outputs, status.fileno(), *inherited])
        status.close()
        for _, write in ends:
            os.close(write)
        said = [os.fdopen(read, encoding="utf-8") for read, _ in ends] if ends else [None, None]
        self.stdout: TextIO = said[0] or io.StringIO()
        self.stderr: TextIO = said[1] or io.StringIO()
        self.pid = int(self._status.recv(LENGTH))

    def __enter__(self) -> Forked:
        return self

    def __exit__(self, *_: object) -> None:
        self.stdout.close()
        self.stderr.close()
        self.wait()

    def poll(self) -> int | None:
        """Return the exit code, None while it runs."""
        with suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end; minus the signal that killed it is the code."""
        if self.returncode is None:
            self._status.settimeout(timeout)
            try:
                self.returncode = int(self._status.recv(LENGTH))
            except (TimeoutError, BlockingIOError):
                raise subprocess.TimeoutExpired(self.args, timeout or 0.0) from None
            self._status.close()
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Return what it still writes on either stream until it ends."""
        said: dict[int, str] = {}
        end = None if timeout is None else time.monotonic() + timeout

        def read(place: int, stream: TextIO) -> None:
            said[place] = "" if stream.closed else stream.read()

        readers = [
            threading.Thread(target=read, args=(k, stream), daemon=True)
            for k, stream in enumerate((self.stdout, self.stderr))
        ]
        for reader in readers:
            reader.start()
        for reader in readers:
            reader.join(None if end is None else max(end - time.monotonic(), 0.0))
            if reader.is_alive():
                raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        self.wait(None if end is None else max(end - time.monotonic(), 0.1))
        self.stdout.close()
        self.stderr.close()
        return said[0], said[1]


def begin() -> None:
    """Start the process to fork from, for this one and those that it starts; it ends with it."""
    folder = tempfile.mkdtemp(prefix="bramah-tests-")
    place = str(Path(folder, "forks"))
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(place)
        listener.listen(64)
        number = listener.fileno()
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.forked", str(number)],
            cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, pass_fds=[number],
            start_new_session=True,
        )  # fmt: skip
    os.environ[ADDRESS] = place

    def end() -> None:
        os.environ.pop(ADDRESS, None)
        shutil.rmtree(folder, ignore_errors=True)
        process.communicate(timeout=10.0)

    atexit.register(end)


def _ask(request: dict[str, Any], streams: list[int]) -> None:
    if ADDRESS not in os.environ:
        begin()
    raw = json.dumps(request).encode()
    with socket.socket(socket.AF_UNIX) as link:
        link.connect(os.environ[ADDRESS])
        socket.send_fds(link, [len(raw).to_bytes(LENGTH, "big")], streams)
        link.sendall(raw)


# In the process that is forked.


def imported() -> None:
    """Import what most commands need, and load the compiled bench."""
    sys.modules["aiohttp"] = None  # type: ignore[assignment]  # as the verb `sim` does
    for module in IMPORTED:
        import_module(module)
    del sys.modules["aiohttp"]
    from drivers import registry
    from hil_sim.plant.plant import Plant
    from hil_sim.scenario.file import Scenario
    from rig.runs.rigs import load_rig

    rig = load_rig("shinshu-2dof")
    registry.driver_class(rig.wire.kind)
    Plant(rig, Scenario(), 0)
    assert threading.active_count() == 1


def forked_at_requests(listener: socket.socket) -> str:
    """Fork at every request until standard input ends.

    Returns in the new process alone, with the name of its module.
    """
    while True:
        ready, _, _ = select.select([0, listener.fileno()], [], [])
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if 0 in ready:
            sys.exit()
        link, _ = listener.accept()
        with link:
            head, streams, _, _ = socket.recv_fds(link, LENGTH, MOST)
            length, raw = int.from_bytes(head, "big"), b""
            while len(raw) < length:
                raw += link.recv(length - len(raw))
        if os.fork() == 0:
            listener.close()
            if (child := os.fork()) == 0:
                request = json.loads(raw)
                _as_started_anew(request, streams)
                return str(request["module"])
            _tell_the_end(child, streams)
        for stream in streams:
            os.close(stream)


def _as_started_anew(request: dict[str, Any], streams: list[int]) -> None:
    os.setsid()
    nothing = os.open(os.devnull, os.O_RDONLY)
    for place, stream in enumerate((nothing, *streams[:2])):
        os.dup2(stream, place)
    for stream in (nothing, *streams[:STREAMS]):
        os.close(stream)
    sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
    sys.stderr = os.fdopen(2, "w", 1, "utf-8", "backslashreplace", closefd=False)
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["cwd"])
    sys.argv = ["-c", *request["words"]]
    gc.enable()


def _tell_the_end(child: int, streams: list[int]) -> None:
    """Tell number and exit code of a process, and end."""
    status = streams[STREAMS - 1]
    for stream in {0, 1, 2, *streams} - {status}:
        os.close(stream)
    with suppress(OSError):
        os.write(status, b"%08d" % child)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    with suppress(OSError):
        os.write(status, b"%08d" % code)
    os._exit(0)


def _end(code: int | str | None) -> None:
    """End as the interpreter does, but without clearing its memory, which would copy all of it."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (AttributeError, OSError, ValueError):  # closed, or the disk is full
            sys.exit(code)
    if not isinstance(code, int | None):
        sys.exit(code)
    os._exit((code or 0) & 0xFF)


if __name__ == "__main__":
    gc.disable()
    imported()
    gc.freeze()
    program = forked_at_requests(socket.socket(fileno=int(sys.argv[1])))
    end: int | str | None = None
    try:
        if program == COMMAND:
            import_module(COMMAND).run()
        else:
            run_module(program, run_name="__main__")
    except SystemExit as asked:
        end = asked.code
    _end(end)
