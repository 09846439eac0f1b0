"""A person writes a protocol file; what is wrong in it is named by line, key and expectation."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from protocols.files.library import load, shipped_names
from protocols.files.plan import resolve
from protocols.files.schema import Protocol
from protocols.signals.multisine import Multisine
from protocols.signals.sine import Sine
from rig.model.parse import InputError, parse_model
from rig.runs.rigs import load_rig

GOOD = """\
name: mine
joints: 2
place: {position_gain: 10 V/m, limit: 500 mV}
steps:
  - name: step1
    lock:
      - {joint: 1, at: closed, piston: 5 mm, tolerance: 1.5 mm}
    excite:
      - joint: 2
        signal: {kind: sine, frequency: 2 Hz, amplitude: 500 mV}
        centring: {mode: position-loop, position_gain: 3 V/m}
    repeats: 3
    duration: 4 s
"""


def read(text: str) -> Protocol:
    return parse_model(Protocol, text, "mine.yaml")


def test_units_become_si() -> None:
    protocol = read(GOOD)
    step = protocol.steps[0]
    assert protocol.place.position_gain == 10.0
    assert protocol.place.limit == pytest.approx(0.5)
    assert step.lock[0].piston == pytest.approx(5e-3)
    assert step.lock[0].tolerance == pytest.approx(1.5e-3)
    assert step.excite[0].signal == Sine(kind="sine", frequency=2.0, amplitude=0.5)
    assert step.excite[0].centring.position_gain == 3.0
    assert step.duration == 4.0


REFUSED = [
    ("repeats: 3", "repeat: 3", "mine.yaml:12: steps.0.repeat: unknown key"),
    ("position_gain: 10 V/m", "position_gain: 10", "mine.yaml:3: .*has no unit"),
    ("position_gain: 10 V/m", "position_gain: 10 V", "mine.yaml:3: .*is of another dimension"),
    ("amplitude: 500 mV", "amplitude: 500 kg", "mine.yaml:10: .*is of another dimension"),
    ("frequency: 2 Hz", "frequency: 0 Hz", "mine.yaml:10: .*greater than 0"),
    ("at: closed", "at: open", "mine.yaml:7: .*'end_min'"),
    ("at: closed", "at: end_min", "mine.yaml:7: .*piston belongs to a lock at 'closed'"),
    ("joint: 1", "joint: 2", "mine.yaml:5: .*joint 2 stands more than once"),
    ("joint: 1", "joint: 3", "mine.yaml:5: .*joint 3 does not exist.*joints: 2"),
    ("joints: 2", "joints: 3", "joint 3 is neither locked nor excited"),
    (
        "kind: sine",
        "kind: square",
        "mine.yaml:10: .*kind: expected one of .*'sine'.* found 'square'",
    ),
    ("kind: sine, ", "", "mine.yaml:10: .*expected a key 'kind', found"),
    ("limit: 500 mV", "limit: 100 mV", "mine.yaml:3: .*push 0.4 V is above the limit 0.1 V"),
    ("repeats: 3", "repeats: yes", "mine.yaml:12: steps.0.repeats: expected a number, found true"),
    ("repeats: 3", "repeats: 0", "mine.yaml:12: steps.0.repeats"),
    (
        "name: step1",
        "name: Step 1",
        "mine.yaml:5: steps.0.name: expected text that matches .*Step 1",
    ),
    (
        "name: step1",
        f"name: step{'1' * 80}",
        "mine.yaml:5: steps.0.name: expected text of at most 80 characters, found",
    ),
    ("name: mine", f"name: mine{'1' * 80}", "mine.yaml:1: name: expected text of at most 80"),
]


@pytest.mark.parametrize(("old", "new", "message"), REFUSED)
def test_what_is_wrong_is_named(old: str, new: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(GOOD.replace(old, new))
    assert "\n" not in str(caught.value)


def test_two_steps_of_one_name_are_refused() -> None:
    step = GOOD[GOOD.index("  - name") :]
    with pytest.raises(InputError, match="two steps are called 'step1'"):
        read(GOOD + step)


def test_a_multisine_states_its_detection_lines_once() -> None:
    line = "{kind: multisine, base_frequency: 0.1 Hz, f_min: 1 Hz, f_max: 5 Hz, amplitude: 1 V, "
    sine = "{kind: sine, frequency: 2 Hz, amplitude: 500 mV}"
    good = read(GOOD.replace(sine, line + "seed: 3, detection_lines: [11, 21]}"))
    signal = good.steps[0].excite[0].signal
    assert isinstance(signal, Multisine)
    assert signal.detection_lines == (11, 21)
    both = "seed: 3, detection_lines: [11], detection_fraction: 0.2}"
    with pytest.raises(InputError, match="not both"):
        read(GOOD.replace(sine, line + both))
    with pytest.raises(InputError, match="f_max 5 Hz is below f_min 6 Hz"):
        read(GOOD.replace(sine, (line + "seed: 3}").replace("f_min: 1 Hz", "f_min: 6 Hz")))


def test_the_shipped_protocols_are_those_of_the_contract() -> None:
    names = shipped_names()
    assert {"lock-and-excite", "lock-and-excite-multisine", "validate"} <= set(names)
    for name in names:
        assert load(name).name == name


def test_a_file_of_ones_own_is_read_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(GOOD, encoding="utf-8")
    assert load(path).name == "mine"


def test_a_missing_file_names_what_there_is() -> None:
    with pytest.raises(InputError, match=r"no-such: cannot be read.*lock-and-excite"):
        load("no-such")


def test_a_binary_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text file"):
        load(path)


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
    | st.sampled_from(["1 Hz", "2 mm", "closed", "sine"]),
    lambda inner: st.lists(inner, max_size=3)
    | st.dictionaries(
        st.sampled_from(["name", "joints", "steps", "lock", "excite", "signal", "at", "joint"]),
        inner,
        max_size=4,
    ),
    max_leaves=12,
)  # fmt: skip


@settings(max_examples=150)
@given(plain)
def test_whatever_a_file_holds_every_problem_is_a_line_that_names_it(content: object) -> None:
    # None of these is a whole protocol: the leaves lack what every one must have.
    with pytest.raises(InputError, match=r"\A(mine\.yaml:\d+: [^\n]*(\n|\Z))+\Z"):
        read(yaml.safe_dump(content))


def test_the_example_in_the_documentation_is_a_protocol_of_the_seed_bench() -> None:
    page = (Path(__file__).parents[2] / "docs" / "protocols.md").read_text("utf-8")
    example = page.split("```yaml\n")[1].split("```")[0]
    plan = resolve(parse_model(Protocol, example, "docs"), load_rig("shinshu-2dof"))
    assert plan.records[-1] == "step2_r4"


def test_all_that_is_wrong_is_listed_at_once() -> None:
    text = GOOD
    wrong = {
        "frequency: 2 Hz": "frequency: 0 Hz",
        "at: closed": "at: open",
        "repeats: 3": "repeats: 0",
    }
    for old, new in wrong.items():
        text = text.replace(old, new)
    with pytest.raises(InputError) as caught:
        read(text)
    lines = str(caught.value).splitlines()
    assert all(re.match(r"mine\.yaml:\d+: ", line) for line in lines)
    numbers = [int(line.split(":")[1]) for line in lines]
    assert numbers == sorted(numbers)
    for says in ("steps.0.repeats", "steps.0.lock.0.at", "frequency"):
        assert sum(says in line for line in lines) == 1, lines
    assert "at least 1 item" not in str(caught.value)  # a list is not short for what is in it
