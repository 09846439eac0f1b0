"""Local sockets through which a screen watches and controls a run; open to their owner only.

Two ZeroMQ sockets per session in a folder of mode 0700: `<rig>-<pid>.pub` (PUB: snapshots) and
`<rig>-<pid>.cmd` (REP: commands). The run never waits for a screen: unread snapshots are dropped,
commands are polled.
Requests and answers are JSON (`rig.bench.screens.commands`): {"command", "value", "holder", "pid"},
then {"ok"}, with a one-line "error" if the command was refused. The answer to "past" has a second
frame (`rig.bench.screens.snapshot`).
"""

from __future__ import annotations

import errno
import json
import logging
import os
import re
import select
import socket
import stat
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq

from rig.bench.screens.commands import (
    COMMANDS,
    PAST,
    Command,
    CommandHolder,
    Judge,
    from_bytes,
    own_command,
    to_bytes,
)
from rig.bench.screens.snapshot import (
    ChannelView,
    PastMinute,
    Snapshot,
    from_json,
    past_from,
    to_json,
)
from rig.runs.runstate import process_alive

__all__ = ["AttachError", "Attachment", "ChannelView", "Endpoint", "Publisher", "Snapshot"]

log = logging.getLogger(__name__)

_MAX_PATH = 100  # largest length of a Unix socket's address [bytes]
_MAX_NAME = 32
_FILE = re.compile(r"^(?P<rig>.+)-(?P<pid>\d+)\.(?:pub|cmd)$")
_COMMANDS_AT_ONCE = 16


class AttachError(Exception):
    """The local sockets cannot be created or are not private; the message says why."""


@dataclass(frozen=True)
class Endpoint:
    """One running session."""

    rig: str
    pid: int
    pub: Path
    cmd: Path


def session_folder() -> Path:
    """Create and return this user's folder for sockets; checks owner, mode 0700 and length."""
    fallback = Path("/tmp") / f"bramah-{os.getuid()}"
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    longest = _MAX_NAME + len("-4194304.pub/bramah")
    if not runtime or not os.path.isabs(runtime) or len(os.fsencode(runtime)) + longest > _MAX_PATH:
        return _private(fallback)
    try:
        return _private(Path(runtime) / "bramah")
    except AttachError as error:
        log.info("%s; using %s", error, fallback)
        return _private(fallback)


def _private(folder: Path) -> Path:
    try:
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        status = folder.lstat()
        if not stat.S_ISDIR(status.st_mode):
            raise AttachError(f"{folder}: is not a folder, perhaps a link; remove it")
        if status.st_uid != os.getuid():
            raise AttachError(
                f"{folder}: belongs to user {status.st_uid}, who could control the bench there; "
                "set XDG_RUNTIME_DIR to a folder of your own"
            )
        if stat.S_IMODE(status.st_mode) != 0o700:
            folder.chmod(0o700)
    except OSError as error:
        raise AttachError(f"{folder}: cannot be used for sockets: {error.strerror}") from error
    return folder


def _address(path: Path) -> str:
    return f"ipc://{path}"


def _listening(path: Path) -> bool:
    """Return whether a process listens at a Unix socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        error = probe.connect_ex(os.fspath(path))
    return error in (0, errno.EAGAIN, errno.EINPROGRESS)


def _sessions(folder: Path) -> list[Endpoint]:
    """Return the running sessions; remove the files of dead processes.

    A process that does not listen yet may be starting, so its files stay.
    """
    sessions = []
    for pub in sorted(folder.glob("*.pub")):
        match = _FILE.match(pub.name)
        if match is None:
            continue
        cmd = pub.with_suffix(".cmd")
        if not process_alive(int(match["pid"])):
            pub.unlink(missing_ok=True)
            cmd.unlink(missing_ok=True)
        elif _listening(pub):
            sessions.append(Endpoint(match["rig"], int(match["pid"]), pub, cmd))
    return sessions


def _pending(socket: zmq.Socket[bytes]) -> bool:
    """Return whether a message has arrived."""
    return bool(int(socket.get(zmq.EVENTS)) & zmq.POLLIN)


class Publisher:
    """The run's end; raises AttachError if the sockets cannot be created."""

    def __init__(self, rig: str, folder: Path | None = None) -> None:
        where = session_folder() if folder is None else _private(folder)
        _sessions(where)
        stem = f"{rig[:_MAX_NAME]}-{os.getpid()}"
        self.endpoint = Endpoint(
            rig[:_MAX_NAME], os.getpid(), where / f"{stem}.pub", where / f"{stem}.cmd"
        )
        self._context = zmq.Context(1)
        self._closed = False
        self._holder = CommandHolder()
        self.past: Callable[[], tuple[dict[str, Any], bytes]] | None = None
        self._watched = False
        self._unread = True  # whether unread commands may have arrived
        try:
            self._pub = self._bind(zmq.XPUB, self.endpoint.pub)  # XPUB receives the subscriptions
            self._cmd = self._bind(zmq.REP, self.endpoint.cmd)
            self._wake = select.poll()
            self._wake.register(int(self._cmd.get(zmq.FD)), select.POLLIN)
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise AttachError(f"{where}: sockets cannot be made: {error}") from error

    def _bind(self, kind: int, path: Path) -> zmq.Socket[bytes]:
        if len(os.fsencode(path)) > _MAX_PATH:
            raise zmq.ZMQError(errno.ENAMETOOLONG)
        path.unlink(missing_ok=True)
        bound = self._context.socket(kind)
        bound.setsockopt(zmq.SNDHWM, 8)
        bound.setsockopt(zmq.RCVHWM, _COMMANDS_AT_ONCE)
        bound.setsockopt(zmq.LINGER, 200)  # [ms] for sending the last snapshot and answer
        bound.setsockopt(zmq.MAXMSGSIZE, 1 << 16)
        bound.bind(_address(path))
        return bound

    @property
    def watched(self) -> bool:
        """Whether any screen is attached, so that snapshots are needed."""
        with suppress(zmq.ZMQError):
            while _pending(self._pub):  # the first to attach, or the last to detach
                self._watched = self._pub.recv(zmq.NOBLOCK)[:1] == b"\1"
        return self._watched

    def publish(self, snapshot: Snapshot) -> None:
        """Publish a snapshot to the attached screens; never waits."""
        with suppress(zmq.ZMQError):
            self._pub.send(to_json(snapshot), zmq.NOBLOCK)

    def commands(self, judge: Judge | None = None) -> list[Command]:
        """Answer the commands that have arrived and return the accepted ones; never waits.

        `judge` returns, for every command but "stop", why it is refused, None if it is accepted.
        """
        accepted: list[Command] = []
        # Polling the file descriptor is much cheaper than asking the library. It stays readable
        # after a message has arrived until the library is asked.
        if not (self._unread or self._wake.poll(0)):
            return accepted
        self._unread = True
        for _ in range(_COMMANDS_AT_ONCE):
            try:
                if not _pending(self._cmd):
                    self._unread = False
                    break
                raw = self._cmd.recv_multipart(zmq.NOBLOCK)[0]
            except zmq.ZMQError:
                break
            command = from_bytes(raw)
            refusal: str | None = f"expected one of: {', '.join(COMMANDS)}"
            if command is not None:
                refusal = self._holder.judge(command, judge)
            answer: dict[str, object] = {"ok": refusal is None}
            frames: list[bytes] = []
            if refusal is not None or command is None:
                answer["error"] = refusal
            elif command.word != PAST:
                accepted.append(command)
            elif self.past is not None:
                header, raw_past = self.past()
                answer.update(header)
                frames.append(raw_past)
            with suppress(zmq.ZMQError):
                self._cmd.send_multipart([json.dumps(answer).encode(), *frames], zmq.NOBLOCK)
        return accepted

    @property
    def holder(self) -> str:
        """The screen in control, '' if there is none."""
        held = self._holder.held
        return "" if held is None else held.holder

    def close(self) -> None:
        """Close and remove the sockets; never raises."""
        if self._closed:
            return
        self._closed = True
        with suppress(zmq.ZMQError):
            self._pub.close()
            self._cmd.close()
            self._context.term()
        for path in (self.endpoint.pub, self.endpoint.cmd):
            with suppress(OSError):
                path.unlink(missing_ok=True)


class Attachment:
    """The screen's end of one session."""

    def __init__(self, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self._context = zmq.Context(1)
        self._sub = self._context.socket(zmq.SUB)
        self._sub.setsockopt(zmq.LINGER, 0)
        self._sub.setsockopt(zmq.RCVHWM, 64)
        self._sub.setsockopt(zmq.SUBSCRIBE, b"")
        self._sub.connect(_address(endpoint.pub))

    @staticmethod
    def find(rig: str | None = None, folder: Path | None = None) -> list[Endpoint]:
        """Return the running sessions (of one rig); raises AttachError for an unsafe folder."""
        sessions = _sessions(session_folder() if folder is None else _private(folder))
        return [e for e in sessions if rig is None or e.rig == rig[:_MAX_NAME]]

    def receive(self, timeout: float) -> Snapshot | None:
        """Return the next snapshot, None after `timeout` [s] without one."""
        try:
            if not self._sub.poll(max(0, round(timeout * 1000))):
                return None
            return from_json(self._sub.recv(zmq.NOBLOCK))
        except (zmq.ZMQError, ValueError) as error:
            log.debug("no snapshot: %s", error)
            return None

    def send(self, command: str, timeout: float = 2.0) -> bool:
        """Send a command; return whether the run accepted it within `timeout` [s]."""
        return self.ask(own_command(command), timeout) is None

    def ask(self, command: Command, timeout: float = 2.0) -> str | None:
        """Send a command; return None if the run accepted it, else the reason in one line."""
        answer = self._exchange(command, timeout)
        return answer if isinstance(answer, str) else None

    def past(self, timeout: float = 2.0) -> PastMinute | None:
        """Return the run's last minute and its plan; None without a valid answer."""
        answer = self._exchange(own_command(PAST), timeout)
        if isinstance(answer, str) or len(answer) != 2:  # header and array
            return None
        try:
            return past_from(json.loads(answer[0]), answer[1])
        except ValueError as error:
            log.debug("no last minute of the run: %s", error)
            return None

    def _exchange(self, command: Command, timeout: float) -> list[bytes] | str:
        """Return the frames of the answer, or the reason in one line why there is none."""
        # A new socket: one without its answer cannot be used again.
        asking = self._context.socket(zmq.REQ)
        asking.setsockopt(zmq.LINGER, 0)
        try:
            asking.connect(_address(self.endpoint.cmd))
            asking.send(to_bytes(command), zmq.NOBLOCK)
            if not asking.poll(round(timeout * 1000)):
                return f"no answer within {timeout:g} s"
            frames = asking.recv_multipart(zmq.NOBLOCK)
            answer = json.loads(frames[0])
            return frames if answer.get("ok") else str(answer.get("error", "refused"))
        except (zmq.ZMQError, ValueError, AttributeError) as error:
            return f"no answer: {error}"
        finally:
            asking.close()

    @property
    def alive(self) -> bool:
        """Whether the run's process is running."""
        return process_alive(self.endpoint.pid)

    def close(self) -> None:
        """Detach from the run, which continues."""
        self._context.destroy(linger=0)
