"""Discovery of plug-ins: every class of a kind in the modules of a folder."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from types import ModuleType


def classes_in(package: ModuleType, base: type) -> tuple[type, ...]:
    """Return the concrete subclasses of `base` in the modules of `package`, by module name.

    A class is taken from the module that defines it; names that begin with '_' are left out.
    """
    classes: list[type] = []
    for entry in sorted(pkgutil.iter_modules(package.__path__), key=lambda m: m.name):
        module = importlib.import_module(f"{package.__name__}.{entry.name}")
        for name, item in vars(module).items():
            if not inspect.isclass(item) or name.startswith("_") or item is base:
                continue
            if issubclass(item, base) and item.__module__ == module.__name__:
                classes.append(item)
    return tuple(classes)
