"""A lab sheet as a file: parameters, sweeps, includes, questions, and what is wrong with them."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from protocols.files.library import load, parsed_values, read_protocol, shipped_names
from protocols.files.plan import piston_gain, resolve
from protocols.files.schema import VERSION, Protocol, protocol_schema
from protocols.language.conditions import parse_condition
from protocols.language.waveforms import start_centred
from protocols.signals import SIGNALS
from protocols.steps import STEPS
from protocols.steps.prompt import PromptStep
from rig.model.parse import InputError, load_yaml
from rig.model.rig import Rig
from rig.runs.rigs import load_rig

HEAD = "name: sheet\njoints: 2\n"
SINE = """\
  - name: sine
    lock: [{joint: 1, at: closed}]
    excite:
      - {joint: 2, signal: {kind: sine, frequency: 1 Hz, amplitude: $amplitude}}
"""


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("shinshu-2dof")


def read(body: str, **values: object) -> Protocol:
    return read_protocol(HEAD + body, "sheet.yaml", values)


def amplitudes(protocol: Protocol) -> list[float]:
    return [step.excite[0].signal.volts for step in protocol.excitations]


def test_a_parameter_is_given_in_the_file_or_on_the_command_line() -> None:
    body = "parameters: {amplitude: 0.2 V}\nsteps:\n" + SINE
    assert amplitudes(read(body)) == [0.2]
    assert amplitudes(read(body, **parsed_values(["amplitude=300 mV"]))) == [pytest.approx(0.3)]


def test_a_parameter_that_the_file_does_not_have_is_refused() -> None:
    body = "parameters: {amplitude: 0.2 V}\nsteps:\n" + SINE
    with pytest.raises(InputError, match="no parameter 'size'; the file has: amplitude"):
        read(body, size="1 V")
    with pytest.raises(InputError, match=r"sheet\.yaml:7: \$amplitude: no parameter"):
        read("steps:\n" + SINE)
    with pytest.raises(InputError, match="expected NAME=VALUE"):
        parsed_values(["amplitude"])


def test_an_amplitude_in_millimetres_moves_the_piston_by_them(rig: Rig) -> None:
    """Against the closed form of a sine: the volts are s w / k."""
    body = "parameters: {amplitude: 20mm}\nsteps:\n" + SINE
    (step,) = resolve(read(body), rig).steps
    expected = 0.02 * 2 * np.pi / piston_gain(rig, 1)
    assert np.abs(step.excite[0].wave.samples).max() == pytest.approx(expected, rel=1e-4)


def test_a_sweep_makes_products_and_rows() -> None:
    inner = SINE.replace("\n", "\n    ").replace("  - name", "      - name", 1).rstrip() + "\n"
    head = "parameters: {amplitude: 0.1 V, other: 1}\nsteps:\n"
    product = read(head + "  - sweep: {amplitude: [0.1 V, 0.2 V], other: [1, 2, 3]}\n"
                   "    steps:\n" + inner)  # fmt: skip
    assert amplitudes(product) == [0.1, 0.1, 0.1, 0.2, 0.2, 0.2]
    assert [s.name for s in product.excitations][-1] == "sine_6"
    assert product.excitations[3].parameters == {"amplitude": "0.2 V", "other": "1"}
    rows = read(head + "  - sweep: [{amplitude: 0.3 V}, {amplitude: 0.1 V}]\n    steps:\n" + inner)
    assert amplitudes(rows) == [0.3, 0.1]


def test_ten_thousand_steps_are_refused_with_their_number() -> None:
    values = ", ".join(["1"] * 100)
    body = (
        "parameters: {a: 1, b: 1}\nsteps:\n"
        f"  - sweep: {{a: [{values}], b: [{values}]}}\n    steps: [{{mark: x}}]\n"
    )
    with pytest.raises(InputError, match=r"sheet\.yaml:5: 10000 steps; expected at most 1000"):
        read(body)


def test_nested_sweeps_are_counted_before_they_are_made() -> None:
    values = ", ".join(["1"] * 40)
    body = (
        "parameters: {a: 1, b: 1}\nsteps:\n"
        f"  - sweep: {{a: [{values}]}}\n    steps:\n"
        f"      - sweep: {{b: [{values}]}}\n        steps: [{{mark: x}}]\n"
    )
    with pytest.raises(InputError, match="1600 steps"):
        read(body)


def test_set_holds_for_the_steps_after_it() -> None:
    body = "parameters: {amplitude: 0.1 V}\nsteps:\n" + SINE + "  - set: {amplitude: 0.4 V}\n"
    twice = read(body + SINE.replace("name: sine", "name: again"))
    assert amplitudes(twice) == [0.1, 0.4]


def test_an_include_brings_the_steps_of_another_file(tmp_path: Path) -> None:
    (tmp_path / "inner.yaml").write_text(
        HEAD + "parameters: {amplitude: 0.1 V}\nsteps:\n" + SINE, encoding="utf-8"
    )
    outer = tmp_path / "outer.yaml"
    outer.write_text(
        HEAD + "steps:\n  - include: inner.yaml\n"
        "  - {include: inner.yaml, parameters: {amplitude: 0.2 V}}\n", encoding="utf-8"
    )  # fmt: skip
    made = load(outer)
    assert amplitudes(made) == [0.1, 0.2]
    assert [s.name for s in made.excitations] == ["sine", "sine_2"]


def test_steps_nested_in_a_file_that_is_included_twice_have_names_of_their_own(
    tmp_path: Path,
) -> None:
    nested = "".join(f"    {line}\n" for line in SINE.replace("$amplitude", "0.1 V").splitlines())
    inner = HEAD + "steps:\n  - repeat_until: b.rsd < 0.5 %\n    at_most: 2\n    steps:\n" + nested
    (tmp_path / "inner.yaml").write_text(inner, encoding="utf-8")
    outer = tmp_path / "outer.yaml"
    outer.write_text(HEAD + "steps:\n" + 2 * "  - include: inner.yaml\n", encoding="utf-8")
    assert [s.name for s in load(outer).excitations] == ["sine", "sine_2"]


def test_a_circle_of_includes_is_refused_with_its_chain(tmp_path: Path) -> None:
    for name, other in (("a", "b"), ("b", "c"), ("c", "a")):
        text = f"{HEAD}steps:\n  - include: {other}.yaml\n"
        (tmp_path / f"{name}.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"circular: \S+a\.yaml -> \S+b\.yaml -> \S+c\.yaml -> "):
        load(tmp_path / "a.yaml")


def test_an_included_file_that_is_missing_is_named_with_the_line_that_includes_it(
    tmp_path: Path,
) -> None:
    outer = tmp_path / "outer.yaml"
    outer.write_text(f"{HEAD}steps:\n  - include: inner.yaml\n", encoding="utf-8")
    line = HEAD.count("\n") + 2
    with pytest.raises(InputError, match=rf"outer\.yaml:{line}: include: .*inner\.yaml: cannot be"):
        load(outer)


def test_what_is_wrong_in_an_included_file_names_that_file(tmp_path: Path) -> None:
    (tmp_path / "inner.yaml").write_text(f"{HEAD}steps:\n  - pause: 5 V\n", encoding="utf-8")
    (tmp_path / "outer.yaml").write_text(
        f"{HEAD}steps:\n  - include: inner.yaml\n", encoding="utf-8"
    )
    with pytest.raises(InputError, match=r"inner\.yaml:4: steps\.0\.pause"):
        load(tmp_path / "outer.yaml")


def test_an_included_step_that_does_not_fit_a_rig_is_named_with_its_own_file_and_line(
    tmp_path: Path, rig: Rig
) -> None:
    inner = tmp_path / "inner.yaml"
    body = HEAD + "steps:\n  - mark: begin\n" + SINE.replace("$amplitude", "9 V")
    inner.write_text(body, encoding="utf-8")
    last = tmp_path / "last.yaml"
    last.write_text(body.replace("sine\n", "last\n"), encoding="utf-8")
    outer = tmp_path / "outer.yaml"
    outer.write_text(
        HEAD + "steps:\n  - mark: a\n  - mark: b\n  - include: inner.yaml\n  - repeat_until: "
        "oil_temperature > 40 degC\n    at_most: 2\n    steps: [{include: last.yaml}]\n",
        encoding="utf-8",
    )
    with pytest.raises(InputError) as caught:
        resolve(load(outer), rig)
    first, second = str(caught.value).splitlines()
    assert first.startswith(f"{inner}:5: step 'sine', joint 2: ")
    assert second.startswith(f"{last}:5: step 'last', joint 2: ")


def test_all_mistakes_of_a_file_are_listed_at_once(tmp_path: Path) -> None:
    """In steps, sweeps, `set`, templates and an included file: each with its file and line."""
    (tmp_path / "inner.yaml").write_text(
        HEAD + "steps:\n  - pause: 5 V\n  - mark: $who\n", encoding="utf-8"
    )
    outer = tmp_path / "outer.yaml"
    outer.write_text(
        HEAD + "retry: {times: 99}\nparameters: {amplitude: 0.1 V}\nsteps:\n"
        "  - set: {size: 1 V}\n"
        "  - sweep: {amplitude: [], other: [1, 2]}\n"
        "    steps:\n"
        "      - {mark: x, colour: red}\n"
        "      - pause: $rest\n"
        "  - include: inner.yaml\n"
        "  - hold: 3 bar\n"
        "  - jump: 3\n", encoding="utf-8"
    )  # fmt: skip
    with pytest.raises(InputError) as caught:
        load(outer, {"speed": "1 m/s"})
    said = str(caught.value).replace(f"{tmp_path}/", "").splitlines()
    for line in (
        "outer.yaml: no parameter 'speed'",
        "outer.yaml:3: retry.times",
        "outer.yaml:6: no parameter 'size'",
        "outer.yaml:7: sweep amplitude: an empty list",
        "outer.yaml:7: no parameter 'other'",
        "outer.yaml:9: steps.0.colour: unknown key",
        "outer.yaml:10: $rest: no parameter 'rest'",
        "inner.yaml:4: steps.0.pause",
        "inner.yaml:5: $who: no parameter 'who'",
        "outer.yaml:12: steps.",
        "outer.yaml:13: steps.",
    ):
        assert sum(text.startswith(line) for text in said) == 1, (line, said)
    assert len(said) == 11, said


def test_all_that_does_not_fit_a_rig_is_listed_at_once(rig: Rig) -> None:
    made = read(
        "steps:\n  - {wait_until: piston_9 > 1 mm, timeout: 1 s}\n"
        "  - {wait_until: R13 > 1 kg*m^2, timeout: 1 s}\n"
    )
    with pytest.raises(InputError) as caught:
        resolve(made, rig)
    assert len(str(caught.value).splitlines()) == 2


def test_a_file_of_a_later_version_is_refused_in_a_sentence() -> None:
    text = f"version: {VERSION + 1}\nname: x\nunknown: 1\n"
    with pytest.raises(InputError) as caught:
        read_protocol(text, "later.yaml")
    assert str(caught.value) == (
        f"later.yaml:1: version {VERSION + 1} is later than this program reads, which is "
        f"{VERSION}; use a newer bramah"
    )


def test_yes_and_no_of_yaml_are_answers() -> None:
    made = read("steps:\n  - prompt: Go?\n    default: yes\n    answers: [yes, no]\n"
                "    timeout: 5 s\n")  # fmt: skip
    (prompt,) = made.steps
    assert isinstance(prompt, PromptStep)
    assert (prompt.default, prompt.answers) == ("yes", ("yes", "no"))


@pytest.mark.parametrize(
    ("step", "message"),
    [
        ("wait_until: oil_temperature > 40\n    timeout: 1 s", "has no unit"),
        ("wait_until: oil_temperature > 40 bar\n    timeout: 1 s", "is of another dimension"),
        ("wait_until: __import__('os')\n    timeout: 1 s", "is no comparison"),
        ("wait_until: piston_9 > 1 mm\n    timeout: 1 s", "has no channel 'piston_9'"),
        ("wait_until: R13 > 1 kg*m^2\n    timeout: 1 s", "has no parameter 'R13'"),
        ("jump: 3", "expected a key that names the kind of step (excite, hold,"),
        # A misspelt kind is one mistake, though its other keys fit another kind.
        ("name: s\n    exite: []\n    warm_up: 1", "found the keys name, exite, warm_up"),
        ("hold: 5 s\n    lock: [{joint: 1, at: end_min}]", "expected 'at: closed'"),
        ("prompt: x\n    timeout: 1 s\n    default: maybe", "'maybe' is none of: yes, no"),
        ("repeat_until: b.rsd < 1 %\n    at_most: 3\n    steps: []", "steps.0.steps"),
    ],
)
def test_a_step_that_makes_no_sense_is_named(rig: Rig, step: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        resolve(read(f"steps:\n  - {step}\n"), rig)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_condition_compares_in_si_and_never_by_what_is_unknown() -> None:
    warm = parse_condition("oil_temperature > 40 degC and supply_pressure >= 6.5 MPa or b.rsd < 2%")
    assert warm.names == ("oil_temperature", "supply_pressure", "b.rsd")
    assert warm.estimates == ("b",)
    assert warm.holds({"oil_temperature": 41.0, "supply_pressure": 6.6e6})
    assert not warm.holds({"oil_temperature": 41.0})
    assert warm.holds({"b.rsd": 0.019})
    assert not warm.holds({"b.rsd": float("nan")})


def test_the_values_a_condition_compares_are_shown_in_an_operators_units() -> None:
    condition = parse_condition("oil_temperature > 40 degC and piston_1 < 2 cm or b.rsd < 2 %")
    values = {"oil_temperature": 38.24, "piston_1": 0.0251}
    assert condition.readings(values) == "oil_temperature 38.24 °C, piston_1 25.1 mm, b.rsd unknown"
    timed = parse_condition("elapsed > 2 min")
    assert timed.readings({"elapsed": 3.0}) == "it compares the time alone"


@settings(max_examples=300)
@given(st.text(max_size=60))
def test_any_text_is_a_condition_or_refused_in_one_line(text: str) -> None:
    try:
        found = parse_condition(text)
    except ValueError:
        return
    assert found.names
    assert not found.holds({})


def test_a_signal_too_large_to_compute_is_refused_with_its_size() -> None:
    samples = 1e308 * np.sin(2 * np.pi * np.arange(100) / 100)
    with pytest.raises(ValueError, match=r"reaches 1e\+308 V; expected an amplitude within"):
        start_centred(samples, np.array([1]))


@pytest.mark.parametrize("kind", ["chirp", "step", "ramp", "triangle"])
def test_a_signal_starts_centred_and_keeps_its_size(kind: str) -> None:
    rest = {
        "chirp": {"f_min": 0.5, "f_max": 5.0, "period": 10.0},
        "step": {"width": 0.5, "rest": 0.5},
        "ramp": {"rise": 1.0, "hold": 0.5, "rest": 0.25},
        "triangle": {"frequency": 0.5},
    }[kind]
    (found,) = [s for s in SIGNALS if s.model_fields["kind"].annotation.__args__ == (kind,)]
    wave = found(kind=kind, amplitude=0.5, **rest).waveform(1000.0)
    assert np.abs(wave.samples).max() == pytest.approx(0.5, rel=0.05)
    assert abs(wave.samples.mean()) < 1e-12
    way = np.cumsum(np.tile(wave.samples, 2)) / 1000.0
    assert abs(0.5 * (way.max() + way.min()) - way.mean()) < 0.6 * np.ptp(way)
    assert wave.lines[-1] * 1000.0 / wave.period < 125.0


def test_a_file_of_volts_is_a_signal(tmp_path: Path, rig: Rig) -> None:
    t = np.arange(0.0, 2.0, 0.01)
    rows = "\n".join(f"{a:.4f},{0.3 * np.sin(np.pi * a):.6f}" for a in t)
    (tmp_path / "wave.csv").write_text(f"time,volts\n{rows}\n", encoding="utf-8")
    sheet = tmp_path / "sheet.yaml"
    step = SINE.replace("kind: sine, frequency: 1 Hz, amplitude: $amplitude",
                        "kind: file, file: wave.csv")  # fmt: skip
    sheet.write_text(HEAD + "steps:\n" + step, encoding="utf-8")
    (plan,) = resolve(load(sheet), rig).steps
    assert plan.period == 2000
    assert plan.excite[0].wave.lines[0] == 1
    assert np.abs(plan.excite[0].wave.samples).max() == pytest.approx(0.3, rel=0.01)
    (tmp_path / "wave.csv").write_text("time,volts\n1,2\n0,x\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"wave\.csv:3: '0,x' is no row of numbers"):
        load(sheet)


def test_a_python_protocol_passes_the_same_checks(tmp_path: Path, rig: Rig) -> None:
    path = tmp_path / "falling.py"
    path.write_text(
        'PROTOCOL = {"name": "falling", "joints": 2, "parameters": {"sizes": 3}}\n'
        "def steps(parameters):\n"
        '    for n in range(parameters["sizes"]):\n'
        '        yield {"name": f"size_{n}", "lock": [{"joint": 1, "at": "closed"}],\n'
        '               "excite": [{"joint": 2, "signal": {"kind": "sine",\n'
        '                           "frequency": "1 Hz", "amplitude": f"{0.1 * (n + 1)} V"}}]}\n',
        encoding="utf-8",
    )
    assert len(resolve(load(path, {"sizes": 4}), rig).steps) == 4
    path.write_text('PROTOCOL = {"name": "x", "joints": 2}\ndef steps(p):\n    while True:\n'
                    '        yield {"mark": "on"}\n', encoding="utf-8")  # fmt: skip
    with pytest.raises(InputError, match="more than 1000 steps"):
        load(path)
    path.write_text('PROTOCOL = {"name": "x", "joints": 2}\ndef steps(p):\n    yield 1 / 0\n',
                    encoding="utf-8")  # fmt: skip
    with pytest.raises(InputError, match="steps\\(\\) raised ZeroDivisionError"):
        load(path)


@pytest.mark.parametrize("leaves", ["sys.exit(0)", "sys.exit(3)", "raise RuntimeError('no oil')"])
def test_a_python_protocol_that_leaves_the_program_is_refused_by_its_line(
    leaves: str, tmp_path: Path
) -> None:
    path = tmp_path / "leaving.py"
    path.write_text(
        "import sys\nPROTOCOL = {'name': 'leaving', 'joints': 2}\n"
        f"def steps(parameters):\n    yield {{'hold': '1 s'}}\n    {leaves}\n"
    )
    kind = "SystemExit" if "exit" in leaves else "RuntimeError"
    with pytest.raises(InputError, match=f"{path}:5: steps\\(\\) raised {kind}: "):
        load(path)


def test_what_a_python_protocol_prints_does_not_mix_with_the_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "talking.py"
    path.write_text(
        "print('read')\nPROTOCOL = {'name': 'talking', 'joints': 2}\n"
        "def steps(parameters):\n    print('made')\n    yield {'hold': '1 s'}\n"
    )
    load(path)
    assert capsys.readouterr() == ("", "read\nmade\n")


def test_the_schema_knows_every_kind() -> None:
    text = json.dumps(protocol_schema())
    assert all(f'"{key}"' in text for key in STEPS)
    assert all(f'"#/$defs/{signal.__name__}"' in text for signal in SIGNALS)
    assert protocol_schema()["properties"]["version"]["maximum"] == VERSION


def documented_sheet() -> str:
    """The lab sheet that the documentation shows."""
    page = (Path(__file__).parents[2] / "docs" / "protocols.md").read_text("utf-8")
    (example,) = [part.split("```")[0] for part in page.split("```yaml\n") if "evening" in part]
    return example


def test_the_lab_sheet_of_the_documentation_resolves_on_the_seed_bench(rig: Rig) -> None:
    plan = resolve(read_protocol(documented_sheet(), "docs", {"amplitude": "9 mm"}), rig)
    assert plan.records.count("sine_4_r3") == 1
    assert plan.records[-1] == "rest_r1"
    assert plan.estimates == ("b",)


def test_editors_accept_every_shipped_protocol_and_the_documentations_lab_sheet() -> None:
    judge = Draft202012Validator(protocol_schema())
    judge.check_schema(protocol_schema())
    for name in shipped_names():
        text = (resources.files("protocols") / "shipped" / f"{name}.yaml").read_text("utf-8")
        judge.validate(load_yaml(text, name)[0])
    judge.validate(load_yaml(documented_sheet(), "protocols.md")[0])


@pytest.mark.parametrize(
    ("found", "wrong"),
    [
        ("frequency: 1 Hz", "frequenzy: 1 Hz"),
        ("kind: sine", "kind: sign"),
        ("- mark: x", "- marc: x"),
        ("timeout: 30 s", "timeout: 30"),
        ("default: yes", "default: 3"),
        ("joints: 2", "joints: two"),
        ("version: 2", "version: 3"),
        ("amplitude: 0.2 V", "amplitude: 0.2"),
        ("at: closed", "at: open"),
    ],
)
def test_editors_mark_what_the_reader_refuses(found: str, wrong: str) -> None:
    text = (
        f"version: 2\n{HEAD}steps:\n{SINE.replace('$amplitude', '0.2 V')}"
        "  - {prompt: Is it warm, answers: [yes, no], default: yes, timeout: 30 s}\n  - mark: x\n"
    )
    judge = Draft202012Validator(protocol_schema())
    judge.validate(load_yaml(text, "sheet.yaml")[0])
    read_protocol(text, "sheet.yaml")
    spoilt = text.replace(found, wrong)
    assert spoilt != text
    with pytest.raises(InputError):
        read_protocol(spoilt, "sheet.yaml")
    assert not judge.is_valid(load_yaml(spoilt, "sheet.yaml")[0])
