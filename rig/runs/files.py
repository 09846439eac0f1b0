"""Files and folders: read with limits, replaced atomically, synchronised to disk."""

from __future__ import annotations

import fcntl
import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rig.model.parse import InputError

MAX_TEXT = 1 << 20  # [bytes], far above any real text file
CACHE_VARIABLE = "BRAMAH_CACHE"
_SCRATCH = "bramah-scratch-"
_UNLOCKED_SECONDS = 5.0  # a new scratch folder is locked long before


def cache_folder() -> Path:
    """Return the cache folder: $BRAMAH_CACHE, or one in the user's cache folder."""
    stated = os.environ.get(CACHE_VARIABLE)
    if stated:
        return Path(stated)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "bramah"


def read_text(path: Path, what: str, limit: int = MAX_TEXT) -> str:
    """Return the UTF-8 text of a file; raises InputError. `what` names the file's kind."""
    try:
        if path.is_dir():
            raise InputError(f"{path}: is a folder; expected {what}")
        if not path.is_file() and path.exists():
            raise InputError(f"{path}: is not a regular file; expected {what}")
        with path.open("rb") as stream:
            raw = stream.read(limit + 1)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected {what}") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path}: cannot be read ({reason}); expected {what}") from error
    if len(raw) > limit:
        raise InputError(f"{path}: larger than {limit // 1024} KiB; expected {what}")
    if b"\0" in raw:
        raise InputError(f"{path}: a binary file; expected {what} as text")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"{path}:{line}: byte {error.start} is not UTF-8; save {what} as UTF-8 text"
        ) from error


def json_text(data: Any, indent: int | None = None) -> str:
    """Return data as JSON; numbers that are not finite, which JSON has none of, become null.

    Keys become text, numbers of numpy plain ones, all else its text.
    """
    return json.dumps(_plain(data), indent=indent, allow_nan=False, default=str)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def sync_to_disk(path: Path) -> None:
    """Make a file's content, or a folder's names, survive a power cut; raises OSError."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def no_place_for(path: Path) -> str:
    """Return why no file or folder of this name can be created, '' if it can; creates nothing.

    Missing folders above it can be created if the last existing one is writable.
    """
    try:
        above = path.absolute().parent
        while not above.exists() and not above.is_symlink():
            above = above.parent
        if not above.is_dir():
            return f"{above} is no folder"
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        return getattr(error, "strerror", None) or str(error)
    return "" if os.access(above, os.W_OK | os.X_OK) else f"the folder {above} cannot be written"


def write_text(path: Path, text: str) -> None:
    """Write a file as `replace_text` does, with the folders above it; raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_text(path, text)


def replace_text(path: Path, text: str) -> None:
    """Replace a file atomically: a reader sees the old or the new text; raises OSError.

    A byte of a file's name that is not UTF-8 is written as the terminal shows it, like \\udcff.
    """
    replace_bytes(path, text.encode("utf-8", "backslashreplace"))


def replace_bytes(path: Path, content: bytes) -> None:
    """Replace a file atomically: a reader sees the old or the new bytes; raises OSError."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        error.filename = os.fspath(path)  # the name that the user knows; a failed write names none
        raise
    finally:
        temporary.unlink(missing_ok=True)
    sync_to_disk(path.parent)


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Yield a temporary folder; removes first those that killed processes of this user left."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_SCRATCH}*"):
        with suppress(OSError):
            _remove_abandoned(folder)
    with tempfile.TemporaryDirectory(prefix=_SCRATCH) as name:
        handle = os.open(name, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)  # held until this process ends, however it ends
            yield Path(name)
        finally:
            os.close(handle)


def _remove_abandoned(folder: Path) -> None:
    """Remove a scratch folder of this user; raises OSError if its process holds it."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        status = os.fstat(handle)
        # A younger one may not be locked yet.
        if status.st_uid == os.getuid() and time.time() - status.st_mtime > _UNLOCKED_SECONDS:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder)
    finally:
        os.close(handle)


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes `out` when all files are written.

    `out` must be absent or empty, and stays so after an error or a kill. Raises OSError.
    """
    target = out.resolve()
    exists = target.exists()
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = (target if exists else target.parent) / f".{target.name}.{os.getpid()}.tmp"
    temporary.mkdir()
    try:
        yield temporary
        files = list(temporary.iterdir())
        for path in (*files, temporary):
            sync_to_disk(path)
        if exists:
            for path in files:
                path.replace(target / path.name)
        else:
            temporary.replace(target)
    except OSError as error:
        if error.errno is not None and error.filename is None:  # a failed write
            error.filename = os.fspath(out)
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    sync_to_disk(target if exists else target.parent)
