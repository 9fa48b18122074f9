"""Experiment files: what is refused, where, with which remedy; places, cases, `--set`, JSON, arenas, link targets."""

import json
import math
import re
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Annotated

import msgspec
import pytest

from agents.body.interface import BodyFault
from agents.formation.link import BY_NOTHING
from agents.plugins import registry
from agents.vectors import Positive
from experiments.catalogue import index
from experiments.check.check import check
from experiments.definition.experiment import LinkTable
from experiments.definition.standby import robots_without_address
from experiments.file import catalogue as entries
from experiments.file import document
from experiments.file.document import DocumentError, read
from experiments.file.problems import line_column, nearest, places
from experiments.file.structure import OBJECT, faults, parse_object
from experiments.file.text import MAX_TEXT_BYTES
from tests.experiments.traces import parse_links
from tests.small import PERIODIC, changed
from twins.body import TwinBody
from twins.device import Faults
from twins.scene import Obstacle

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
        ("trigger=my.py", "no 'my.py' among the triggers", "write 'my.py:CLASS'"),
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
        there = document.received(document.case_document(cases[name], name).decode(), "network")
        assert (there.cases(), document.chosen_case(there, None)) == ({name: cases[name]}, cases[name])


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


LAB = """# A lab
[arena]
size = [4.0, 3.0, 2.0]
walls = false

[arena.obstacles.post]
radius = 0.1
at = [1.0, 0.0]

[arena.obstacles.cart]
box = [0.3, 0.2]
at = [0.0, 1.0]
plan = { kind = "line", move_by = [1.0, 0.0], speed = 0.1 }

[arena.starts.west]
at = [-1.5, 0.0]
size = [0.9, 1.0]
"""
ONE = """title = "One"
duration_s = 20.0
[arena]
file = "lab.toml"
[robots.KH01]
kind = "khepera4"
start = [-1.5, 0.0]
"""


def write_files(folder, experiment=ONE, arena=LAB):
    (folder / "lab.toml").write_text(arena)
    (folder / "one.toml").write_text(experiment)
    return folder / "one.toml"


def test_arena_is_that_of_the_file(tmp_path):
    given = read(write_files(tmp_path))
    arena = given.experiment.arena
    assert (arena.size, arena.walls, arena.file) == ((4.0, 3.0, 2.0), False, None)
    assert arena.obstacles["post"] == Obstacle(radius=0.1, at=(1.0, 0.0))
    assert arena.starts["west"].size == (0.9, 1.0)
    assert given.listing.startswith(ONE)
    assert LAB in given.listing
    kept = tmp_path / "run"
    kept.mkdir()
    given.keep(kept / "experiment.toml")
    # what processes read: there is no lab.toml
    (kept / "case.json").write_bytes(document.write_json(given.plan))
    assert [read(kept / name).experiment for name in ("experiment.toml", "case.json")] == [given.experiment] * 2


def test_own_keys_win_and_obstacles_merge_by_name(tmp_path):
    own = "walls = true\n[arena.obstacles.post]\nheight = 0.5\n[arena.obstacles.cart]\nradius = 0.2\n"
    own += "[arena.starts.east]\nat = [1.5, 0.0]\nsize = [0.5, 0.5]\n"
    arena = read(write_files(tmp_path, ONE.replace('"lab.toml"\n', f'"lab.toml"\n{own}'))).experiment.arena
    assert (arena.walls, arena.size, [*arena.starts]) == (True, (4.0, 3.0, 2.0), ["west", "east"])
    assert arena.obstacles["post"] == Obstacle(radius=0.1, at=(1.0, 0.0), height=0.5)
    cart = arena.obstacles["cart"]  # another shape in place of the old one; the rest stays
    assert (cart.box, cart.radius, cart.at) == (None, 0.2, (0.0, 1.0))


def test_case_changes_the_arena_or_takes_another_file(tmp_path):
    (tmp_path / "hall.toml").write_text("[arena]\nsize = [9.0, 9.0, 3.0]\n[arena.obstacles.pillar]\nradius = 0.4\n")
    cases = '[cases.lab.arena.obstacles.post]\nradius = 0.2\n[cases.hall.arena]\nfile = "hall.toml"\n'
    given = read(write_files(tmp_path, ONE + cases))
    found = {name: plan.experiment.arena for name, plan in given.cases().items()}
    assert [each.obstacles["post"].radius for each in (found["lab"], given.experiment.arena)] == [0.2, 0.1]
    assert ([*found["hall"].obstacles], found["hall"].size) == (["pillar"], (9.0, 9.0, 3.0))
    files = {name: file.name for name, file in given.source.arenas.items()}
    assert files == {"": "lab.toml", "lab": "lab.toml", "hall": "hall.toml"}


def test_command_line_changes_find_what_the_file_holds(tmp_path):
    file = write_files(tmp_path)
    found = read(file, ["arena.obstacles.cart.plan.speed=0.2", "arena.obstacles.post.at=[0.5, 0.5]"]).experiment.arena
    assert found.obstacles["cart"].plan == {"kind": "line", "move_by": [1.0, 0.0], "speed": 0.2}
    assert found.obstacles["post"].at == (0.5, 0.5)
    (tmp_path / "hall.toml").write_text("[arena]\nsize = [9.0, 9.0, 3.0]\n")
    assert read(file, ["arena.file=hall.toml", "arena.walls=false"]).experiment.arena.obstacles == {}
    assert refusal(file, "arena.file=hal.toml").problems[0].file == "--set arena.file=hal.toml"
    (problem,) = refusal(file, "arena.obstacles.cart.plan.radius=0.2").problems
    assert "no plan of this experiment has a parameter 'radius'" in problem.message


@pytest.mark.parametrize(
    ("arena", "place", "message", "hint"),
    [
        ("[arena]\nsize = [4.0, 3.0]\n", (2, 8), "'size' must be a list of length 3", ""),
        ("[arena]\nsiez = [4.0, 3.0, 2.0]\n", (2, 1), "unknown key 'siez' in 'arena'", "'size'"),
        ("size = [4.0, 3.0, 2.0]\n", (1, 1), "unknown key 'size'", ""),
        ("[arena]\n[robots.KH01]\nstart = [0.0, 0.0]\n", (2, 2), "unknown key 'robots'", "in the experiment file"),
        ("[arena]\nseed = 3\n", (2, 1), "unknown key 'seed' in 'arena'", "'seed' belongs in the experiment file"),
        ('[arena]\nfile = "hall.toml"\n', (2, 1), "an arena file cannot name another", ""),
        ("[arena]\n[arena.obstacles.a]\nradius = 0.1\nat = [9.0, 0.0]\n", (4, 6), "'a' stands outside", ""),
        ("", (0, 0), "is empty", ""),
        ("# nothing\n", (0, 0), "holds nothing but comments", ""),
    ],
)
def test_wrong_arena_file_is_refused_where_wrong(tmp_path, arena, place, message, hint):
    problem = refusal(write_files(tmp_path, arena=arena)).problems[0]
    assert (problem.file, problem.line, problem.column) == (str(tmp_path / "lab.toml"), *place)
    assert message in problem.message
    assert hint in problem.hint


def test_conflicts_with_the_arena_point_into_both_files(tmp_path):
    small = ONE.replace('"lab.toml"\n', '"lab.toml"\nsize = [2.0, 3.0, 2.0]\n')
    problems = refusal(write_files(tmp_path, small)).problems
    problem, *_ = refusal(write_files(tmp_path, ONE + "[cases.small.arena]\nsize = [3.9, 1.0, 2.0]\n")).problems
    found = [(Path(each.file).name, each.line) for each in (*problems, problem)]
    assert found == [("one.toml", 8), ("lab.toml", 16), ("one.toml", 8)]
    assert problem.message.startswith("in case 'small', arena.obstacles.cart.at: 'cart' stands outside")


def test_catalogue_arena_files_are_no_experiments(tmp_path):
    assert not any("arena" in name for name in index.names())
    made = entries.copy_entry("obstacle-course", tmp_path)
    assert read(made).experiment == read("obstacle-course").experiment
    assert {file.name for file in tmp_path.iterdir()} == {made.name, "gate.arena.toml", index.SCHEMA}
    (tmp_path / "gate.arena.toml").write_text("[arena]\n")
    with pytest.raises(DocumentError, match="is another arena"):
        entries.copy_entry("obstacle-course", tmp_path / "again.toml")
    assert not (tmp_path / "again.toml").exists()


def test_arena_file_is_of_the_catalogue_or_beside(tmp_path):
    arena = read(write_files(tmp_path, ONE.replace("lab.toml", "gate.arena.toml"))).experiment.arena
    assert list(arena.obstacles) == ["left", "right"]
    for name in ("experiment.toml", "Experiment.TOML", "run.json", "event.mcap"):  # files of a run
        (tmp_path / name).write_text(LAB)
        with pytest.raises(DocumentError, match="call it otherwise"):
            read(write_files(tmp_path, ONE.replace("lab.toml", name)))


AVERAGE = index.find_file("average")
SHAPE = """
title = "Shape"
duration_s = 10.0
[robots]
TB01 = { kind = "turtlebot3", start = [0.0, 0.0] }
KH01 = { kind = "khepera4", start = [-0.5, 0.4] }
CF01 = { kind = "crazyflie", start = [0.5, 0.4], hover = 0.6 }
[formation.shape]
TB01 = [1.0, 1.0]
KH01 = [0.7, 1.4]
CF01 = [1.0, 1.8]
[formation.links]
"TB01 > KH01" = "shape"
"KH01 - CF01" = { gain = 2.0 }
"TB01 > CF01" = 0.7
"""


def links_of(text, *changes, case="default"):
    return document.loads(text, *changes).cases()[case].experiment.formation.links


def test_lengths_hold_between_places_at_robots_heights():
    found = links_of(SHAPE)
    assert found["TB01 > KH01"] == LinkTable(distance=pytest.approx(0.5))
    assert found["KH01 - CF01"] == LinkTable(distance=pytest.approx(math.hypot(0.3, 0.4, 0.6)), gain=2.0)
    assert found["TB01 > CF01"] == 0.7


@pytest.mark.parametrize("law", registry.names(registry.LAWS))
def test_law_has_the_target_that_it_needs(law):
    found = links_of(SHAPE.replace(" = 0.7", ' = "shape"'), f'formation.law="{law}"')
    assert len(found) == 3
    target = {"displacement": "offset", "bearing": "bearing"}.get(law)
    assert target is None or getattr(found["TB01 > KH01"], target) == pytest.approx([-0.3, 0.4])


def test_case_command_line_and_change_move_places():
    text = SHAPE + "[cases.near]\nformation.shape.KH01 = [0.7, 1.0]\n[cases.far]\nformation.shape.KH01 = [0.0, 1.0]\n"
    found = [
        links_of(text, case="near"),
        links_of(text, case="far"),
        links_of(SHAPE, "formation.shape.KH01=[1.0, 3.0]"),
    ]
    assert [links["TB01 > KH01"].distance for links in found] == pytest.approx([0.3, 1.0, 2.0])
    text = SHAPE + "[[formation.changes]]\nat_s = 5.0\nshape = { TB01 = [0, 0], KH01 = [0, 2], CF01 = [0, 1] }\n"
    (change,) = document.loads(text).experiment.formation.changes
    assert change.links["TB01 > KH01"].distance == pytest.approx(2.0)
    assert set(change.links) == {"TB01 > KH01", "KH01 - CF01"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("formation.update=send-on-delta", "no function of its input alone"),
        ('architecture={ kind = "hybrid", robots = ["KH01"] }', "guided robots transmit no variables"),
        ("formation.anchors={ KH01 = 0.5 }", "'average' does not know them"),
        ("cases.event.trigger=relative", "'relative' judges errors of links"),
        ("cases.event.trigger=self-triggered", "does not see the variables"),
        ("formation.law=distance", "needs a target of every link"),
        ("formation.law=mixed", "give a distance, an offset or a bearing"),
    ],
)
def test_averaging_law_needs_no_targets(change, message):
    with pytest.raises(DocumentError, match=message):
        document.read(AVERAGE, [change])
    plan = document.read(AVERAGE, ['formation.links={ "KH01 > KH04" = { from_s = 2.0 } }']).cases()["event"]
    (link,) = plan.one_way_links
    assert (link.sender, link.receiver, link.since, link.target.wants) == ("KH01", "KH04", 2.0, BY_NOTHING)


@pytest.mark.slow
def test_check_warns_of_words_that_are_lost():
    text = AVERAGE.read_text("utf-8").replace("duration_s = 30.0", "duration_s = 2.0")
    for given, warned in ((text, False), (text.replace(", maximum_silence_s = 1.0", ""), True)):
        assert ("lost-words" in {each.code for each in check(document.loads(given))}) is warned


FORMS = '''\
# every form that TOML has
a = 1 # = 2
"b c".'d.e' = [ 1, # one ]
  { x = "]}", y.z = 2 }, """three
"quotes" \\""" and more""""", 4 ]
when = 1979-05-27 07:32:00
[t . "u\\u00e9"]
k = \'\'\'it's
[no.header]\'\'\'
inline = { p = [ [ 1 ], [ ] ], q = {} }
[[l]]
n = 1
[[l]]
n = 2
[l.sub]
m = 'x'
[[l.deep]]
o = -0.5e3
'''


def paths_of(value, path=()):
    yield path
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, each in entries:
        yield from paths_of(each, (*path, key))


@pytest.mark.parametrize("text", [FORMS, *(f.read_text("utf-8") for f in sorted(index.FOLDER.glob("*.toml")))])
def test_document_paths_and_no_others_have_a_place(text):
    assert set(places(text)) == set(paths_of(tomllib.loads(text))) - {()}


@pytest.mark.parametrize(
    ("path", "key", "value"),
    [
        (("a",), (2, 1), (2, 5)),
        (("b c", "d.e"), (3, 7), (3, 15)),
        (("b c", "d.e", 1, "x"), (4, 5), (4, 9)),
        (("b c", "d.e", 1, "y", "z"), (4, 17), (4, 21)),
        (("b c", "d.e", 2), (4, 26), (4, 26)),
        (("b c", "d.e", 3), (5, 30), (5, 30)),
        (("when",), (6, 1), (6, 8)),
        (("t", "ué"), (7, 6), (7, 1)),
        (("t", "ué", "inline", "p", 1), (10, 25), (10, 25)),
        (("l",), (11, 3), (11, 1)),
        (("l", 1), (13, 1), (13, 1)),
        (("l", 1, "sub", "m"), (16, 1), (16, 5)),
        (("l", 1, "deep", 0, "o"), (18, 1), (18, 5)),
    ],
)
def test_places(path, key, value):
    place = places(FORMS)[path]
    assert (line_column(FORMS, place.key), line_column(FORMS, place.value)) == (key, value)


def test_places_in_json_and_of_absent_paths():
    text = '{\n "a\\u00e9": {"b/": [1, {"c": null}]},\n "d": "x, {}"\n}'
    found = places(text, json=True)
    assert line_column(text, found["aé", "b/", 1, "c"].key) == (2, 25)
    assert line_column(text, found[("d",)].value) == (3, 7)
    assert len(found) == 6
    found = places(FORMS)
    assert nearest(found, ("l", 1, "sub", "missing"))[0] == ("l", 1, "sub")
    assert nearest(found, ("missing", "a")) == ((), nearest(found, ())[1])


@pytest.mark.parametrize(
    ("text", "messages", "hint"),
    [
        ("[1]", ["is no JSON object"], OBJECT),
        ("", ["is not JSON: Input data was truncated"], OBJECT),
        ('{"loss": }', ["is not JSON: invalid character (byte 9)"], OBJECT),
        ("[" * 20_000, ["is not JSON: maximum recursion depth exceeded while deserializing an object"], OBJECT),
        ('{"los": 1, "battery": "full"}', ["unknown key 'los'", "'battery' must be a number, not 'full'"], "'loss'"),
    ],
)
def test_wrong_json_behind_a_flag_has_a_remedy(text, messages, hint):
    with pytest.raises(DocumentError) as refused:
        parse_object("--faults", text, Faults)
    assert [problem.message for problem in refused.value.problems] == messages
    assert hint in refused.value.problems[0].hint
    assert all(problem.file.startswith("--faults ") for problem in refused.value.problems)
    for struct in (None, Faults):
        assert parse_object("--faults", '{"loss": 0.05}', struct) == {"loss": 0.05}


def test_one_case_may_be_named_as_text():
    assert list(document.chosen(document.load("triangle"), "event")) == ["event"]


class Zone(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    radius: Positive


class Zoned(msgspec.Struct, frozen=True):
    zones: tuple[Zone, ...] = ()
    more: list[Zone] = []


@pytest.mark.parametrize("name", ["zones", "more"])
def test_faults_in_lists_of_tables_have_keys(name):
    wrong = {name: [{"radius": 1.0}, {"radius": -1.0}, {"raduis": 1.0}]}
    assert [(each.path, each.message, each.hint) for each in faults(wrong, Zoned)] == [
        ((name, 1, "radius"), "'radius' must be a number > 0, not -1.0", ""),
        ((name, 2, "raduis"), f"unknown key 'raduis' in '{name}[2]'", "did you mean 'radius'?"),
    ]
    assert [each.message for each in faults({name: {"radius": 1.0}}, Zoned)] == [
        f"'{name}' must be a list, not a table"
    ]


class CrawlerSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    gear: Annotated[int, msgspec.Meta(ge=1, le=5)] = 1


class Crawlers(TwinBody):
    """Body of a user."""

    SETTINGS = CrawlerSettings

    @classmethod
    def faults(cls, robots):
        yield from super().faults(robots)
        for each in robots:
            if not each.address.endswith(":5005"):
                yield BodyFault(each.name, ("body",), f"{each.name} has no port", "write crawler://HOST:5005")


def test_body_of_a_user_judges_its_robots(monkeypatch, write):
    before, entry = registry.registered, EntryPoint("crawler", f"{__name__}:Crawlers", registry.BODIES)
    mine = {registry.BODIES: {"crawler": [entry]}}
    monkeypatch.setattr(registry, "registered", lambda group: before(group) | mine.get(group, {}))
    wrong = TWO.replace("start = [0.0, 0.0]", 'start = [0.0, 0.0]\nbody = "crawler://a"')
    wrong += 'body = "crawler://b:5005"\ndevice = { gear = 9 }\n'
    problems = [(each.line, each.message, each.hint) for each in refusal(write(wrong)).problems]
    assert problems == [
        (6, "KH01 has no port", "write crawler://HOST:5005"),
        (11, "'gear' must be a whole number <= 5, not 9", "left out: 1"),
    ]
    read(write(wrong.replace("crawler://a", "crawler://a:5005").replace("gear = 9", "gear = 2")))
