"""Places of values in TOML and JSON, and faults of JSON behind flags."""

import tomllib

import pytest

from experiments.catalogue import index
from experiments.file.problems import DocumentError, line_column, nearest, places
from experiments.file.structure import OBJECT, parse_object
from twins.devices.device import Faults

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
        ("[" * 6000, ["is not JSON: maximum recursion depth exceeded while deserializing an object"], OBJECT),
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
