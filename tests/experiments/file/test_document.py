import itertools
import json
import re
from pathlib import Path

import pytest

from experiments.catalogue import index
from experiments.file import catalogue as entries
from experiments.file import document
from experiments.file.document import DocumentError, read
from experiments.file.text import MAX_TEXT_BYTES
from tests.experiments.traces import parse_links

MALFORMED = Path(__file__).parent / "malformed"


PARK = index.FOLDER / "robotic-park.toml"


MINIMAL = 'title = "One"\nduration_s = 10.0\n[robots.KH01]\nkind = "khepera4"\nstart = [0.0, 0.0]\n'


# file, line, column, part of the message, part of the remedy; a file may have several
EXPECTED = [
    ("arena-file-folder", 9, 8, "'labs/lab.toml' is no name of a file", "beside the experiment file"),
    ("cases-by-capitals", 9, 8, "differ by capitals only", "rename one"),
    ("arena-file-missing", 9, 8, "there is no arena file", "known: gate.arena.toml"),
    ("avoidance-parameter", 10, 1, "unknown parameter 'margn' of 'barrier'", "did you mean 'margin'?"),
    ("avoidance-without-kind", 8, 1, "'avoidance' needs its kind", 'add kind = "barrier"'),
    ("bad-name", 4, 9, "'KH 01' cannot be a name", "letters, digits and _, beginning with a letter"),
    ("case-contradiction", 13, 1, "in case 'low', robots.CF01.hover: 'CF01' cannot hover at 0.8 m", "at most 0.45"),
    ("case-in-case", 8, 14, "a case cannot hold cases", "at the top of the file"),
    ("criterion-in-case", 9, 15, "a case cannot hold criteria", "at the top of the file"),
    ("criterion-limit", 8, 1, "a criterion needs a limit", "add at_most = 0.5"),
    ("criterion-metric", 9, 10, "no 'iea' among the metrics", "did you mean 'iae'?"),
    ("criterion-metric", 10, 8, "no case 'event' in this experiment", "known: default"),
    ("criterion-metric", 11, 6, "no robot is called 'KH02'", "did you mean 'KH01'?"),
    ("case-key", 9, 1, "unknown key 'gian' in 'formation'", "did you mean 'gain'?"),
    ("case-parameter", 12, 37, "unknown parameter 'treshold' of 'send-on-delta'", "did you mean 'threshold'?"),
    ("disturbance-of-nobody", 8, 14, "'kephera4' is neither a robot nor a kind", "did you mean 'khepera4'?"),
    ("disturbance-limit", 14, 26, "'sigma' must be a number >= 0, not -0.01", "standard deviation"),
    ("empty", 0, 0, "is empty", "zenpark new"),
    ("engine-parameter", 10, 1, "unknown parameter 'frction' of 'pymunk'", "did you mean 'friction'?"),
    ("hover-above-arena", 11, 9, "'CF01' cannot hover at 2.6 m: the arena is 2.5 m high", "a hover of at most 2.45"),
    ("hover-missing", 8, 1, "'CF01' is a crazyflie, which flies", "add hover = 0.8"),
    ("hover-on-the-ground", 7, 1, "'KH01' is a khepera4, which does not fly", "leave hover out"),
    ("infinite-arena", 9, 14, "'size[1]' is inf", "give a finite number"),
    ("key-twice", 7, 1, "kind stands here a second time, first in line 5", "rename or remove"),
    ("leg-after-the-end", 9, 8, "begins at 11 s, when the run of 10 s is over", "a longer duration_s"),
    ("leg-unknown-robot", 10, 9, "no robot is called 'KH02'", "did you mean 'KH01'?"),
    ("legs-out-of-order", 14, 8, "this leg of 'KH01' begins at 2 s", "the one before begins at 5 s"),
    ("link-arrow", 14, 1, "'KH01 -> CF01' is no link", 'write "KH01 > CF01" when CF01 receives from KH01'),
    ("link-negative", 14, 17, "'KH01 - CF01' must be a number > 0, not -0.9", 'write "KH01 - CF01" = 0.5, in metres'),
    ("link-table", 14, 35, "unknown key 'gian' in 'KH01 - CF01'", "did you mean 'gain'?"),
    ("link-to-itself", 15, 1, "'KH01' cannot receive from itself", "name two robots"),
    ("link-twice", 15, 1, "from CF01 to KH01 stands twice, as 'KH01 - CF01' and 'CF01>KH01'", "remove one"),
    ("link-word", 14, 17, "'KH01 - CF01' must be a number or a table, not 'near'", '"KH01 - CF01" = "shape"'),
    ("json-in-toml", 1, 1, "is JSON, and its name says TOML", "rename it to .json"),
    ("radio-half", 7, 8, "no 'radio:/0/80' among the bodies", "radio://0/80/2M/E7E7E7E701"),
    ("shape-one-number", 16, 8, "'KH01' must be numbers, x, y (, z) [m], not [0.3]", "write KH01 = [0.5, 0.0]"),
    ("link-unknown-robot", 14, 1, "no robot is called 'CF10'", "did you mean 'CF01'?"),
    ("misplaced-key", 5, 1, "unknown key 'duration_s' in 'arena'", "above the first [table]"),
    ("missing-duration", 1, 1, "'duration_s' is missing", "add duration_s = 30.0"),
    ("missing-start", 4, 1, "'start' is missing in 'KH01'", "add start = [0.0, 0.0]"),
    ("misspelt-required", 2, 1, "unknown key 'duratoin_s'", "did you mean 'duration_s'?"),
    ("negative-hover", 11, 9, "'hover' must be a number > 0, not -0.8", "height that a flying robot holds"),
    ("no-robots", 1, 1, "'robots' is missing", "[robots.KH01] with kind"),
    ("not-a-number", 2, 14, "'duration_s' is nan", "give a finite number"),
    ("only-comments", 0, 0, "nothing but comments", "zenpark new"),
    ("obstacle-above-arena", 10, 10, "'lamp' begins at 2.5 m: the arena is 2.5 m high", "a bottom below 2.5"),
    ("obstacle-called-robot", 8, 18, "'KH01' is the name of a robot already", "rename one of them"),
    ("obstacle-called-wall", 8, 18, "an obstacle cannot be called 'wall'", "rename it"),
    ("obstacle-key", 9, 1, "unknown key 'radus' in 'cart'", "did you mean 'radius'?"),
    ("obstacle-mass-with-plan", 9, 7, "only a box or a cylinder without a plan can have a mass", "leave mass out"),
    ("obstacle-no-shape", 8, 1, "an obstacle has exactly one of box, radius and wall", "for example box ="),
    ("obstacle-outside", 10, 6, "'post' stands outside of the arena", "x lies between -2 and 2"),
    ("obstacle-plan-parameter", 11, 36, "`radius` must be a number other than 0", ""),
    ("obstacle-plan-unknown", 11, 17, "no 'lime' among the planners", "did you mean 'line'?"),
    ("obstacle-two-shapes", 10, 7, "an obstacle has exactly one of box, radius and wall", "for example box ="),
    ("obstacle-wall-with-plan", 9, 8, "a wall cannot have a plan, because it does not move", "use a box"),
    ("parameter-of-another", 3, 32, "unknown parameter 'threshold' of 'periodic'", "it is a parameter of 'pred"),
    ("plan-missing", 11, 8, "'radius' is missing in 'plan'", "add radius ="),
    ("plan-own-check", 11, 52, "`radius` must be a number other than 0", ""),
    ("process-like-robot", 7, 11, "'KH02' is the name of a robot", "rename the process"),
    ("process-of-a-role", 7, 11, "'recorder' is a process of every run", "rename it"),
    ("rate-not-dividing", 10, 11, "pose_hz = 40 does not divide body_hz = 100", "pose_hz = 50"),
    ("reserved-name", 4, 9, "a robot cannot be called 'run'", "rename it"),
    ("robot-twice", 13, 1, "[robots.KH01] stands here a second time, first in line 4", "rename or remove"),
    ("robots-as-list", 4, 1, "'robots' must be tables with names", "write [robots.KH01]"),
    ("start-box-outside", 9, 6, "the start box 'west' reaches 0.55 m beyond the arena along x", "move it"),
    ("start-in-obstacle", 6, 9, "'KH01' starts in the obstacle 'crate'", "by 0.08 m or more"),
    ("start-outside", 6, 10, "'KH01' starts outside of the arena", "x lies between -2 and 2"),
    ("start-outside-boxes", 6, 9, "'KH01' starts outside of the boxes", "'west' around (-1.5, 0)"),
    ("start-too-short", 6, 9, "'start' must be a list of length >= 2", "x, y [m]"),
    ("syntax-no-equals", 2, 12, "Expected '='", "a line is key = value"),
    ("syntax-no-quotes", 5, 8, "Invalid value", "text stands in quotes"),
    ("syntax-open-header", 4, 13, "Expected ']'", "a header is [table]"),
    ("syntax-open-list", 7, 1, "Unclosed array", "lacks its ]"),
    ("syntax-open-text", 1, 13, "Illegal character", "closing quotes"),
    ("text-for-number", 6, 16, "'start[1]' must be a number, not 'zero'", "x, y [m]"),
    ("timeline-one-bracket", 8, 1, "'timeline' must be a list", "write [[timeline]]"),
    ("trigger-parameter", 11, 1, "unknown parameter 'treshold'", "did you mean 'threshold'?"),
    ("trigger-value", 10, 13, "'threshold' must be a number > 0, not 0.0", "[m]"),
    ("trigger-without-kind", 3, 11, "'trigger' needs its kind", 'add kind = "'),
    ("unknown-avoidance", 3, 13, "no 'barier' among the avoidances", "did you mean 'barrier'?"),
    ("unknown-body", 7, 8, "no 'twn' among the bodies", "did you mean 'twin'?"),
    ("unknown-engine", 9, 10, "no 'pymonk' among the engines", "did you mean 'pymunk'?"),
    ("unknown-key", 14, 1, "unknown key 'gian' in 'formation'", "did you mean 'gain'?"),
    ("unknown-key", 15, 1, "unknown key 'clmap' in 'formation'", "did you mean 'clamp'?"),
    ("unknown-kind", 5, 8, "no 'kephera4' among the kinds of robots", "did you mean 'khepera4'?"),
    ("unknown-leader", 14, 10, "no robot is called 'kh01'", "did you mean 'KH01'?"),
    ("unknown-sensor", 7, 24, "no 'lidar' among the range sensors", "known: multiranger, infrared, ultrasonic, lds01"),
    ("unknown-trigger", 3, 20, "no 'periodc' among the triggers", "did you mean 'periodic'?"),
    ("wrong-word", 9, 11, "'missing' cannot be 'goon'", "did you mean 'go-on'?"),
    ("yaw-in-degrees", 6, 21, "the yaw is in radians", "90 degrees are 1.5708"),
]


def refused(path, *overrides):
    with pytest.raises(DocumentError) as caught:
        read(path, overrides)
    return caught.value


@pytest.fixture
def write(tmp_path):
    """Writes a file and gives its path."""

    def written(content, name="some.toml"):
        file = tmp_path / name
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        return file

    return written


@pytest.mark.parametrize("name", sorted({name for name, *_ in EXPECTED}))
def test_malformed_file_is_refused_in_place_with_remedy(name):
    error = refused(MALFORMED / f"{name}.toml")
    expected = [row[1:] for row in EXPECTED if row[0] == name]
    assert [(p.line, p.column) for p in error.problems] == [(line, column) for line, column, *_ in expected]
    for problem, (_, _, message, remedy) in zip(error.problems, expected, strict=True):
        assert message in problem.message
        assert remedy in problem.hint
        assert problem.message in str(error)
        assert problem.hint in str(error)


@pytest.mark.parametrize("name", ["recorder", "world", "centre", "vicon", "conductor", "mean"])
def test_roles_of_a_run_name_no_robot(write, name):
    (problem,) = refused(write(MINIMAL.replace("KH01", name))).problems
    assert (problem.line, problem.column) == (3, 9)


def test_every_malformed_file_is_expected_and_there():
    assert {file.stem for file in MALFORMED.glob("*.toml")} == {name for name, *_ in EXPECTED}


def test_problem_shows_the_line_and_the_column(write):
    file = write(MINIMAL + "\n[formation]\n\tgian = 2.0\n")
    assert str(refused(file)) == (
        f"{file}:8:2: unknown key 'gian' in 'formation'\n"
        "     8 | \tgian = 2.0\n"
        "       | \t^\n"
        "       = did you mean 'gain'?"
    )


def test_a_long_line_is_cut_around_the_place(write):
    error = refused(write(f'title = "{"x" * 500}"\n' + MINIMAL[14:].replace("10.0", " " * 300 + '"no" # ' + "y" * 300)))
    _, source, caret, _ = str(error).split("\n")
    assert len(source) < 120
    assert source[caret.index("^") :].startswith('"no"')


def test_problems_of_file_and_cases_come_in_order(write):
    text = (
        MINIMAL
        + "[channel]\nlos = 0.1\ndelay_s = -1.0\n[safety]\nmargin = true\n"
        + "[cases.a]\nsed = 2\n[cases.b.channel]\nloss = 2\n"
    )
    assert [(p.line, p.message) for p in refused(write(text)).problems] == [
        (7, "unknown key 'los' in 'channel'"),
        (8, "'delay_s' must be a number >= 0, not -1.0"),
        (10, "'margin' must be a number, not true"),
        (12, "unknown key 'sed'"),
        (14, "'loss' must be a number <= 1, not 2"),
    ]


def test_contradictions_come_all_at_once(write):
    text = (
        MINIMAL.replace("khepera4", "tank")
        + '[formation.links]\n"A > KH01" = 1.0\n"KH01 > KH01" = 1.0\n[rates]\npose_hz = 33\n'
    )
    assert [p.line for p in refused(write(text)).problems] == [4, 7, 8, 10]


def slips(text):
    """Every line `key = value` of a file, with its key misspelt: table and key, the number of the line, the text that
    results."""
    lines, table = text.split("\n"), ""
    for number, line in enumerate(lines, 1):
        if line.startswith("["):
            table = re.sub(r"\b[A-Z]{2}\d+\b", "a robot", line.partition("#")[0].strip())
        elif known := re.match("([a-z_]+) =", line):
            yield (table, known[1]), number, "\n".join([*lines[: number - 1], f"x{line}", *lines[number:]])


@pytest.mark.slow
def test_every_misspelt_key_is_found_in_its_line(write):
    tried = set()
    for name in index.names():
        found = list(slips(entries.path(name).read_text("utf-8")))
        assert len(found) > 10
        for place, number, text in found:
            if place not in tried:  # the same key of the same table in another file is read by the same rules
                tried.add(place)
                lines = [(problem.line, problem.column) for problem in refused(write(text)).problems]
                assert (number, 1) in lines, (name, place)
    assert len(tried) > 30


# Files that are not what they should be


def test_absent_file_names_the_nearest_of_the_catalogue():
    (problem,) = refused("robotic-prk").problems
    assert "neither a file nor an experiment of the catalogue" in problem.message
    assert "did you mean 'robotic-park'?" in problem.hint


def test_a_folder_names_the_experiments_in_it(write):
    file = write(MINIMAL)
    (problem,) = refused(file.parent).problems
    assert (problem.message, problem.hint) == ("is a folder", "name a file in it: some.toml")


@pytest.mark.parametrize(
    ("content", "place", "message", "hint"),
    [
        (b"\x89PNG\0\0", (0, 0), "is binary", "name an experiment file"),
        (b'title = "Ma\xf1as"\n', (1, 12), "byte 0xf1 is not UTF-8", "save the file as UTF-8"),
        (b" \n\t\n", (0, 0), "is empty", "zenpark new"),
        (b"\xef\xbb\xbf", (0, 0), "is empty", "zenpark new"),
        (b"a = " + b"1" * 5000, (0, 0), "is no TOML", "smaller number"),
        (b"a = " + b"[" * 5000 + b"]" * 5000, (0, 0), "nested too deeply", "flatten"),
        (b"#" * (MAX_TEXT_BYTES + 1), (0, 0), "is longer than 4 MB", "not a recording"),
    ],
)
def test_a_file_that_is_no_experiment(write, content, place, message, hint):
    (problem,) = refused(write(content)).problems
    assert (problem.line, problem.column) == place
    assert message in problem.message
    assert hint in problem.hint


@pytest.mark.parametrize("name", ["a\0b", "x" * 5000, ""])
def test_names_that_no_file_can_have(name):
    assert len(refused(name).problems) == 1


def test_foreign_line_ends_and_byte_order_marks_work(write):
    assert read(write("\ufeff" + MINIMAL.replace("\n", "\r\n"))).experiment.title == "One"


# Cases


def experiments(read):
    return {name: plan.experiment for name, plan in read.cases().items()}


def test_cases_are_experiments_in_the_files_order():
    cases = experiments(read("robotic-park"))
    assert list(cases) == ["periodic", "event"]
    assert cases["periodic"].trigger == {"kind": "periodic", "period_s": 0.02}
    assert cases["event"].trigger == {"kind": "send-on-delta", "threshold": 0.01}
    assert all(case.cases == {} and len(case.robots) == 7 for case in cases.values())


def test_without_cases_there_is_one_called_default(write):
    found = read(write(MINIMAL))
    assert found.cases() == {"default": found.plan}


def test_case_merges_tables_and_replaces_choices_between_kinds(write):
    text = (
        MINIMAL
        + '[robots.KH02]\nkind = "khepera4"\nstart = [1.0, 0.0]\n[formation.links]\n"KH01 - KH02" = 1.0\n'
        + '[trigger]\nkind = "send-on-delta"\nthreshold = 0.03\nmaximum_silence_s = 2.0\n'
        + "[cases.same.trigger]\nthreshold = 0.05\n"
        + '[cases.other]\ntrigger = { kind = "periodic", period_s = 0.1 }\n'
        + '[cases.wide]\nrobots.KH02.start = [1.5, 0.0]\nformation.links."KH02-KH01" = { distance = 1.5, gain = 2.0 }\n'
    )
    cases = experiments(read(write(text)))
    assert cases["same"].trigger == {"kind": "send-on-delta", "threshold": 0.05, "maximum_silence_s": 2.0}
    assert cases["other"].trigger == {"kind": "periodic", "period_s": 0.1}
    assert cases["wide"].robots["KH02"].start == [1.5, 0.0]
    assert cases["wide"].robots["KH02"].kind == "khepera4"
    assert parse_links(cases["wide"]) == [("KH01", "KH02", 1.5, 2.0), ("KH02", "KH01", 1.5, 2.0)]
    assert parse_links(cases["same"]) == [("KH01", "KH02", 1.0, 3.0), ("KH02", "KH01", 1.0, 3.0)]


# --set


def set_on_park(*overrides):
    return experiments(read("robotic-park", overrides))


def test_set_changes_every_case():
    assert [case.robots["CF01"].hover for case in set_on_park("robots.CF01.hover=0.7").values()] == [0.7, 0.7]
    assert [case.title for case in set_on_park("title=Two words").values()] == ["Two words"] * 2
    assert [case.title for case in set_on_park('title="12"').values()] == ["12"] * 2


def test_set_of_a_parameter_reaches_cases_having_it():
    cases = set_on_park("trigger.threshold=0.02")
    assert cases["event"].trigger == {"kind": "send-on-delta", "threshold": 0.02}
    assert cases["periodic"].trigger == {"kind": "periodic", "period_s": 0.02}


def test_set_of_a_whole_choice_beats_the_cases():
    cases = set_on_park("trigger.kind=periodic")
    assert [case.trigger["kind"] for case in cases.values()] == ["periodic"] * 2


def test_set_of_one_case_beats_set_of_all():
    for flags in itertools.permutations(["cases.event.trigger.threshold=0.05", "trigger.threshold=0.02"]):
        assert set_on_park(*flags)["event"].trigger["threshold"] == 0.05
    assert set_on_park("cases.event.seed=9")["event"].seed == 9
    assert set_on_park("cases.event.seed=9")["periodic"].seed == 1


@pytest.mark.parametrize("key", ['"TB01 > KH01"', "TB01 > KH01", "'TB01>KH01'"])
def test_set_of_a_link_however_it_is_written(key):
    experiment = set_on_park(f"formation.links.{key}=0.5")["event"]
    assert [d for listener, speaker, d, _ in parse_links(experiment) if (listener, speaker) == ("KH01", "TB01")] == [
        0.5
    ]
    assert len(experiment.formation.links) == 12


def test_set_gives_a_link_gain_and_keeps_distance():
    assert ("KH01", "TB01", 0.6, 9.0) in parse_links(set_on_park("formation.links.TB01 > KH01.gain=9")["event"])


def test_set_reaches_into_lists():
    assert set_on_park("timeline.0.plan.speed=0.1")["event"].timeline[0].plan["speed"] == 0.1
    assert set_on_park("robots.CF01.start.1=0.5")["event"].robots["CF01"].start == [-0.2, 0.5]


@pytest.mark.parametrize(
    ("flag", "message", "hint"),
    [
        ("trigger.treshold=1", "no trigger of this experiment has a parameter 'treshold'", "did you mean 'threshold'?"),
        ("cases.event.trigger.treshold=1", "unknown parameter 'treshold'", "did you mean 'threshold'?"),
        ("trigger.threshold=-1", "'threshold' must be a number > 0, not -1", "[m]"),
        ("cases.evnt.seed=1", "the file has no case 'evnt'", "did you mean 'event'?"),
        ("robots.CF09.hover=1", "no robot is called 'CF09'", "did you mean 'CF0"),
        ("robts.CF01.hover=1", "unknown key 'robts'", "did you mean 'robots'?"),
        ("robots.CF01.hovr=1", "unknown key 'hovr' in 'CF01'", "did you mean 'hover'?"),
        ("robots.CF01.hover=high", "'hover' must be a number, not 'high'", "height"),
        ("robots.CF01.hover=5", "'CF01' cannot hover at 5 m", "at most 2.45"),
        ("duration_s.x=1", "'duration_s' is no table", "set duration_s itself"),
        ("timeline.3.at_s=1", "there is no '3' in 'timeline'", "0 to 0"),
        ("timeline.0.at_s=50", "this leg begins at 50 s", "longer duration_s"),
        ("rates.pose_hz=30", "pose_hz = 30 does not divide body_hz = 100", "pose_hz = 25"),
        ("seed=nan", "'seed' is nan", "finite"),
        ("trigger=periodc", "no 'periodc' among the triggers", "did you mean 'periodic'?"),
        ("nonsense", "not of the form path=value", "--set formation.gain=2.5"),
        ("=1", "not of the form path=value", "--set formation.gain=2.5"),
        ("a..b=1", "not of the form path=value", "--set formation.gain=2.5"),
        ("title=\udcff", "characters that are no text", "leave them out"),
    ],
)
def test_a_wrong_set_names_the_flag(flag, message, hint):
    (problem,) = refused("robotic-park", flag).problems
    assert problem.file == f"--set {flag}"
    assert message in problem.message
    assert hint in problem.hint
    assert str(problem).startswith("--set ")


def test_a_leg_has_a_number_and_no_name():
    (problem,) = refused("triangle", "timeline.first.plan.speed=1").problems
    assert (problem.message, problem.hint) == (
        "'timeline' must be a list, not a table",
        "write [[timeline]], with two brackets",
    )


def test_set_hides_no_fault_of_the_file(write):
    file = write(MINIMAL + "[formation]\ngian = 2.0\n")
    problems = refused(file, "formation.gain=x").problems
    assert [(p.file, p.line) for p in problems] == [("--set formation.gain=x", 0), (str(file), 7)]


# JSON


@pytest.mark.parametrize("name", index.names())
def test_json_says_the_same(name, write):
    found = read(name)
    again = read(write(document.write_json(found.plan), "resolved.json"))
    assert again.experiment == found.experiment
    assert again.cases() == found.cases()
    for case in found.cases().values():
        assert read(write(document.write_json(case), "case.json")).plan == case


@pytest.mark.parametrize(
    ("content", "line", "column", "message"),
    [
        (b'{\n  "title": "x",\n  "duration_s": oops\n}', 3, 17, "invalid character"),
        (b'{\n  "title": "x"', 2, 15, "truncated"),
        (b"[1, 2]", 0, 0, "its top must be a table"),
        (b'{"title": 1e999}', 1, 17, "out of range"),
        (b"[" * 100_000, 0, 0, "nested too deeply"),
    ],
)
def test_json_that_is_none(write, content, line, column, message):
    (problem,) = refused(write(content, "some.json")).problems
    assert (problem.line, problem.column) == (line, column)
    assert message in problem.message


def test_a_fault_in_json_is_located(write):
    experiment = json.loads(document.write_json(read("triangle").plan))
    experiment["robots"]["KH02"]["start"][1] = 7.5
    (problem,) = refused(write(json.dumps(experiment, indent=2), "some.json")).problems
    assert problem.source.strip() == "7.5"
    assert problem.column == problem.source.index("7.5") + 1


def test_case_crosses_the_network_with_its_name():
    for name, cases in (("event", read("triangle").cases()), ("default", read("convoy", ["cases={}"]).cases())):
        sent = document.case_document(cases[name], name).decode()
        assert document.received(sent, "network").cases() == {name: cases[name]}
        assert document.chosen_case(document.received(sent, "network"), None) == cases[name]


# Links


def test_links_come_in_the_order_of_the_robots():
    experiment = read("convoy").experiment
    assert parse_links(experiment) == [
        ("KH01", "TB01", 0.45, 12.0),
        ("KH02", "TB01", 0.83, 12.0),
        ("KH02", "KH01", 0.45, 12.0),
        ("KH03", "KH01", 0.83, 12.0),
        ("KH03", "KH02", 0.45, 12.0),
    ]
