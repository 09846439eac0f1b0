"""What a verb loads before it does anything: by the names of modules, not by the clock."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from shutil import copytree

import pytest

from rig.runs.files import CACHE_VARIABLE
from tests.variants import kept

HEAVY = (
    "numpy",
    "scipy",
    "pydantic",
    "pint",
    "numba",
    "h5py",
    "yaml",
    "matplotlib",
    "pymodbus",
    "zmq",
)
SLOW = ("pint", "scipy.signal", "scipy.stats", "scipy.interpolate", "matplotlib", "pymodbus")


def loaded(*arguments: str) -> set[str]:
    """The modules in memory at the end of a command that ended well."""
    code = (
        "import sys\n"
        "from rig.cli.main import run\n"
        "try:\n"
        f"    run({list(arguments)!r})\n"
        "except SystemExit as end:\n"
        "    assert not end.code, end.code\n"
        "print('MODULES', *sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.rpartition("MODULES ")[2].split())


@pytest.mark.parametrize("arguments", [("--help",), ("--version",), ("check", "--help")])
def test_help_loads_no_library_but_the_command_lines(arguments: tuple[str, ...]) -> None:
    modules = loaded(*arguments)
    assert "typer" in modules
    # Typer itself asks pydantic about the options of the verb that is called.
    assert modules.isdisjoint(set(HEAVY) - ({"pydantic"} if len(arguments) > 1 else set()))
    verbs = {name for name in modules if name.startswith(("analysis", "protocols", "hil_sim"))}
    assert verbs == set()


def test_a_protocol_is_proved_without_the_slow_libraries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = Path(os.environ[CACHE_VARIABLE], "rates")
    if compiled.exists():
        copytree(compiled, tmp_path / "rates")
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))  # no proof is kept there yet
    checked = ("check", "lock-and-excite", "--rig", "shinshu-2dof", "--step", "step1")
    modules = loaded(*checked)
    assert "analysis.simulation.simulate" in modules  # it did its work
    # The driver says who keeps the time of the samples, and comes with its library.
    assert modules.isdisjoint(set(SLOW) - {"pymodbus"})
    assert "rig.bench.session" not in modules
    again = loaded(*checked)
    assert again.isdisjoint({*SLOW, "numba", "scipy", "analysis.simulation"})


def completed(line: str, shell: str = "bash") -> list[str]:
    """What a shell would offer for a line that was typed so far."""
    words = line.split(" ")
    given = {
        "bash": {"COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)},
        "zsh": {"_TYPER_COMPLETE_ARGS": line},
        "fish": {"_TYPER_COMPLETE_ARGS": line, "_TYPER_COMPLETE_FISH_ACTION": "get-args"},
    }[shell]
    environment = {**os.environ, "_BRAMAH_COMPLETE": f"complete_{shell}", **given}
    code = "import sys; sys.argv = ['bramah']; from rig.cli.main import run; run()"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout.split()


@pytest.mark.parametrize("shell", kept(["bash", "zsh", "fish"], (0,)))
def test_a_shell_completes_verbs_options_and_shipped_names(shell: str) -> None:
    for line, word in (
        ("bramah che", "check"),
        ("bramah check lab", "lab-sheet"),
        ("bramah queue mo", "move"),
        ("bramah check lab-sheet --amp", "--amplitude-scale"),
        ("bramah run lab-sheet --rig shin", "shinshu-2dof"),
    ):
        assert word in " ".join(completed(line, shell)), line


def test_a_word_that_no_shipped_name_begins_with_is_left_to_the_shells_files() -> None:
    assert completed("bramah check ./my-own") == []
    assert completed("bramah identify ru") == []


def test_the_completion_of_a_shell_is_shown_and_named_after_the_program() -> None:
    code = "from rig.cli.main import run; run(['--show-completion', 'bash'])"
    # The shell is named, not looked for among the parents: the tests may have been started by none.
    named = {**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=named
    )
    assert done.returncode == 0, done.stderr
    assert "complete -o default -F _bramah_completion bramah" in done.stdout


def test_the_command_line_runs_as_a_module_too() -> None:
    call = [sys.executable, "-m", "rig.cli.main", "--help"]
    done = subprocess.run(call, capture_output=True, text=True, check=True)
    assert "Usage: bramah" in done.stdout
