"""Experiment files: what is refused, where and with which remedy; cases, `--set` and JSON."""

import json
import re
from pathlib import Path

import msgspec
import pytest

from experiments.catalogue import index
from experiments.definition.standby import robots_without_address
from experiments.file import catalogue as entries
from experiments.file import document
from experiments.file.document import DocumentError, read
from experiments.file.text import MAX_TEXT_BYTES
from tests.experiments.traces import parse_links
from tests.small import PERIODIC, changed

MALFORMED = Path(__file__).parent / "malformed"
# line, column, part of the message and of the remedy, as the comments of a malformed file have them
EXPECTED = re.compile(r"^# expect: (\d+):(\d+) (.*?)(?: \| (.*))?$", re.MULTILINE)
MINIMAL = 'title = "One"\nduration_s = 10.0\n[robots.KH01]\nkind = "khepera4"\nstart = [0.0, 0.0]\n'
TWO = MINIMAL + '[robots.KH02]\nkind = "khepera4"\nstart = [1.0, 0.0]\n'


def refusal(path, *overrides):
    with pytest.raises(DocumentError) as caught:
        read(path, overrides)
    return caught.value


@pytest.fixture
def write(tmp_path):
    def written(content, name="some.toml"):
        file = tmp_path / name
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        return file

    return written


@pytest.mark.parametrize("file", sorted(MALFORMED.glob("*.toml")), ids=lambda file: file.stem)
def test_malformed_file_is_refused_in_place_with_remedy(file):
    error, expected = refusal(file), EXPECTED.findall(file.read_text("utf-8"))
    assert [(p.line, p.column) for p in error.problems] == [(int(line), int(column)) for line, column, *_ in expected]
    for problem, (_, _, message, remedy) in zip(error.problems, expected, strict=True):
        assert message in problem.message
        assert remedy in problem.hint
        assert problem.message in str(error)
        assert problem.hint in str(error)


def test_problem_shows_the_line_and_the_column(write):
    file = write(MINIMAL + "\n[formation]\n\tgian = 2.0\n")
    assert str(refusal(file)) == (
        f"{file}:8:2: unknown key 'gian' in 'formation'\n"
        "     8 | \tgian = 2.0\n"
        "       | \t^\n"
        "       = did you mean 'gain'?"
    )
    error = refusal(write(MINIMAL.replace("10.0", " " * 300 + '"no" # ' + "y" * 300)))
    _, source, caret, _ = str(error).split("\n")
    assert len(source) < 120
    assert source[caret.index("^") :].startswith('"no"')


@pytest.mark.slow
def test_every_misspelt_key_is_found_in_its_line(write):
    lines = entries.path("robotic-park").read_text("utf-8").split("\n")
    keys = [number for number, line in enumerate(lines) if re.match("([a-z_]+) =", line)]
    assert len(keys) > 10
    for number in keys:
        text = "\n".join([*lines[:number], f"x{lines[number]}", *lines[number + 1 :]])
        assert (number + 1, 1) in [(problem.line, problem.column) for problem in refusal(write(text)).problems]


@pytest.mark.parametrize(
    ("name", "content", "place", "message"),
    [
        ("some.toml", b"\x89PNG\0\0", (0, 0), "is binary"),
        ("some.toml", b'title = "Ma\xf1as"\n', (1, 12), "byte 0xf1 is not UTF-8"),
        ("some.toml", b"\xef\xbb\xbf", (0, 0), "is empty"),
        ("some.toml", b"a = " + b"1" * 5000, (0, 0), "is no TOML"),
        ("some.toml", b"a = " + b"[" * 5000 + b"]" * 5000, (0, 0), "nested too deeply"),
        ("some.toml", b"a." * 50 + b"a = 1", (0, 0), "more than 50 parts"),
        ("some.toml", b"#" * (MAX_TEXT_BYTES + 1), (0, 0), "is longer than 4 MB"),
        ("some.json", b'{\n  "title": "x",\n  "duration_s": oops\n}', (3, 17), "invalid character"),
        ("some.json", b"[1, 2]", (0, 0), "its top must be a table"),
        ("some.json", b"[" * 100_000, (0, 0), "nested too deeply"),
    ],
)
def test_file_that_is_no_experiment(write, name, content, place, message):
    (problem,) = refusal(write(content, name)).problems
    assert (problem.line, problem.column) == place
    assert message in problem.message
    assert problem.hint


def test_absent_file_names_the_nearest_of_the_catalogue(write):
    (problem,) = refusal("robotic-prk").problems
    assert "neither a file nor an experiment of the catalogue" in problem.message
    assert "did you mean 'robotic-park'?" in problem.hint
    (problem,) = refusal(write(MINIMAL).parent).problems
    assert (problem.message, problem.hint) == ("is a folder", "name a file in it: some.toml")
    for name in ("a\0b", "x" * 5000, ""):
        assert len(refusal(name).problems) == 1


def test_networks_that_are_accepted(write):
    two_routers = 'routers = 2\nlisten = ["tcp/127.0.0.1:1", "tcp/127.0.0.1:2"]\n'
    for network in (two_routers, 'topology = "mesh"\naddresses.KH01 = "tcp/127.0.0.1:1"\n'):
        assert read(write(f"{TWO}[network]\n{network}"))


def experiments(read):
    return {name: plan.experiment for name, plan in read.cases().items()}


def test_cases_are_experiments_in_the_files_order(write):
    cases = experiments(read("robotic-park"))
    assert list(cases) == ["periodic", "event"]
    assert all(case.cases == {} and len(case.robots) == 7 for case in cases.values())
    alone = read(write("\ufeff" + MINIMAL.replace("\n", "\r\n")))
    assert alone.cases() == {"default": alone.plan}


def test_case_merges_tables_and_replaces_choices_between_kinds(write):
    text = (
        f'{TWO}[formation.links]\n"KH01 - KH02" = 1.0\n'
        '[trigger]\nkind = "send-on-delta"\nthreshold = 0.03\nmaximum_silence_s = 2.0\n'
        "[cases.same.trigger]\nthreshold = 0.05\n"
        '[cases.other]\ntrigger = { kind = "periodic", period_s = 0.1 }\n'
        '[cases.wide]\nrobots.KH02.start = [1.5, 0.0]\nformation.links."KH02-KH01" = { distance = 1.5, gain = 2.0 }\n'
    )
    cases = experiments(read(write(text)))
    assert cases["same"].trigger == {"kind": "send-on-delta", "threshold": 0.05, "maximum_silence_s": 2.0}
    assert cases["other"].trigger == {"kind": "periodic", "period_s": 0.1}
    assert (cases["wide"].robots["KH02"].start, cases["wide"].robots["KH02"].kind) == ([1.5, 0.0], "khepera4")
    assert parse_links(cases["wide"]) == [("KH01", "KH02", 1.5, 2.0), ("KH02", "KH01", 1.5, 2.0)]
    assert parse_links(cases["same"]) == [("KH01", "KH02", 1.0, 3.0), ("KH02", "KH01", 1.0, 3.0)]


def value(experiment, path):
    found = msgspec.to_builtins(experiment)
    for key in path.split("."):
        found = found[int(key)] if isinstance(found, list) else found[key]
    return found


@pytest.mark.parametrize(
    ("flags", "path", "periodic", "event"),
    [
        ("robots.CF01.hover=0.7", "robots.CF01.hover", 0.7, 0.7),
        ("title=Two words", "title", "Two words", "Two words"),
        ('title="12"; trigger.kind=periodic', "title", "12", "12"),
        ("trigger.threshold=0.02", "trigger", PERIODIC, {"kind": "send-on-delta", "threshold": 0.02}),
        ("trigger.threshold=0.02; cases.event.trigger.threshold=0.05", "trigger", PERIODIC,
         {"kind": "send-on-delta", "threshold": 0.05}),
        ("cases.event.seed=9; seed=5", "seed", 5, 9),
        ("robots.CF01.start.1=0.5", "robots.CF01.start", [-0.2, 0.5], [-0.2, 0.5]),
    ],
)  # fmt: skip
def test_set_changes_cases(flags, path, periodic, event):
    cases = experiments(read("robotic-park", flags.split("; ")))
    assert {name: value(case, path) for name, case in cases.items()} == {"periodic": periodic, "event": event}


@pytest.mark.parametrize(
    ("flag", "message", "hint"),
    [
        ("trigger.treshold=1", "no trigger of this experiment has a parameter 'treshold'", "did you mean 'threshold'?"),
        ("cases.evnt.seed=1", "the file has no case 'evnt'", "did you mean 'event'?"),
        ("robots.CF09.hover=1", "no robot is called 'CF09'", "did you mean 'CF0"),
        ("robots.CF01.hover=high", "'hover' must be a number, not 'high'", "height"),
        ("duration_s.x=1", "'duration_s' is no table", "set duration_s itself"),
        ("timeline.3.at_s=1", "there is no '3' in 'timeline'", "0 to 0"),
        ("trigger=periodc", "no 'periodc' among the triggers", "did you mean 'periodic'?"),
        ("nonsense", "not of the form path=value", "--set formation.gain=2.5"),
        ("a..b=1", "not of the form path=value", "--set formation.gain=2.5"),
        ("title=\udcff", "characters that are no text", "leave them out"),
    ],
)
def test_wrong_set_names_the_flag(flag, message, hint):
    (problem,) = refusal("robotic-park", flag).problems
    assert problem.file == f"--set {flag}"
    assert message in problem.message
    assert hint in problem.hint


def test_set_is_checked_together_with_the_file(write):
    file = write(MINIMAL + "[formation]\ngian = 2.0\n")
    (problem,) = refusal(write(MINIMAL, "other.toml"), "timeline.first.plan.speed=1").problems
    assert problem.message == "'timeline' must be a list, not a table"
    problems = refusal(file, "formation.gain=x").problems
    assert [(p.file, p.line) for p in problems] == [("--set formation.gain=x", 0), (str(file), 7)]


@pytest.mark.parametrize("name", index.names())
def test_json_says_the_same(name, write):
    found = read(name)
    again = read(write(document.write_json(found.plan), "resolved.json"))
    assert again.experiment == found.experiment
    assert again.cases() == found.cases()
    for case in found.cases().values():
        assert read(write(document.write_json(case), "case.json")).plan == case


def test_fault_in_json_is_located(write):
    experiment = json.loads(document.write_json(read("triangle").plan))
    experiment["robots"]["KH02"]["start"][1] = 7.5
    (problem,) = refusal(write(json.dumps(experiment, indent=2), "some.json")).problems
    assert problem.source.strip() == "7.5"
    assert problem.column == problem.source.index("7.5") + 1


def test_case_crosses_the_network_with_its_name():
    for name, cases in (("event", read("triangle").cases()), ("default", read("convoy", ["cases={}"]).cases())):
        sent = document.case_document(cases[name], name).decode()
        assert document.received(sent, "network").cases() == {name: cases[name]}
        assert document.chosen_case(document.received(sent, "network"), None) == cases[name]


def test_processes_on_hosts_get_no_hosts(write):
    hosts = '[hosts.lab1]\naddress = "pi@192.0.2.7"\nrobots = ["KH01"]\ntags = ["radio"]\n'
    plan = read(write(f'{TWO}{hosts}[hosts.board]\nrobots = ["KH02"]\n')).plan
    assert robots_without_address(plan) == {"KH02": "board"}
    there = document.received(document.case_document(plan).decode(), "standard input").experiment
    assert there == changed(plan.experiment, hosts={})


@pytest.mark.parametrize("flag", ['"TB01 > KH01"=0.5', "'TB01>KH01'=0.5", "TB01 > KH01.distance=0.5"])
def test_set_of_a_link_however_it_is_written(flag):
    (experiment, _) = experiments(read("robotic-park", [f"formation.links.{flag}"])).values()
    assert ("KH01", "TB01", 0.5, 3.0) in parse_links(experiment)
    assert len(experiment.formation.links) == 12
