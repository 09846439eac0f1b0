"""Where protocols come from: the shipped ones by name, a person's own by path."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from protocols.files.schema import Protocol
from rig.model.parse import InputError, parse_model


def shipped_names() -> tuple[str, ...]:
    """Name the protocols that come with the program."""
    folder = resources.files("protocols") / "shipped"
    return tuple(sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".yaml")))


def load(name: str | Path) -> Protocol:
    """Read a shipped protocol by name or a file by path; raises InputError saying what is wrong."""
    if str(name) in shipped_names():
        text = (resources.files("protocols") / "shipped" / f"{name}.yaml").read_text("utf-8")
        return parse_model(Protocol, text, f"{name}.yaml")
    path = Path(name)
    try:
        text = path.read_text("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file in UTF-8") from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror or error}); "
            f"shipped protocols are: {' '.join(shipped_names())}"
        ) from error
    return parse_model(Protocol, text, str(path))
