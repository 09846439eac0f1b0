"""What the pools' tests have done elsewhere: each process imports this module alone."""

from __future__ import annotations

import os

import numpy as np

from rig.model.parse import InputError


def square(x: int) -> int:
    return x * x


def broken(x: int) -> int:
    raise InputError(f"item {x} cannot be used")


def about(_: int) -> tuple[int, str | None]:
    return os.getpid(), os.environ.get("OPENBLAS_NUM_THREADS")


def gone(_: int) -> None:
    os._exit(1)


def noise(seed: int) -> float:
    return float(np.random.default_rng(seed).standard_normal())
