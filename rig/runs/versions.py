"""Software versions of a run for run.yaml: package, interpreter, platform and commit."""

from __future__ import annotations

import platform
import subprocess
from importlib import metadata
from pathlib import Path

# Libraries that decode, store or compute data; a repeated run needs the same versions.
_LIBRARIES = ("numpy", "scipy", "numba", "h5py", "pymodbus", "pyserial", "pydantic")
_ROOT = Path(__file__).resolve().parents[2]


def _git(*words: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(_ROOT), *words],
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def commit() -> str | None:
    """Return the commit of the source tree in use ('-dirty' if changed), None if installed."""
    if not (_ROOT / ".git").exists():
        return None
    head = _git("rev-parse", "HEAD")
    if not head:
        return None
    return f"{head}-dirty" if _git("status", "--porcelain", "--untracked-files=no") else head


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def versions() -> dict[str, str]:
    """Return the software versions and the platform of this process."""
    out = {
        "bramah": _version("bramah") or "unknown",
        "python": platform.python_version(),
        "platform": platform.platform(),
        **{name: version for name in _LIBRARIES if (version := _version(name)) is not None},
    }
    source = commit()
    return out if source is None else {**out, "commit": source}
