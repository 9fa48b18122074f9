"""Any input ends in a document or in a `DocumentError` that can be printed."""

import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.catalogue import index
from experiments.file.document import DocumentError, read, write_json
from experiments.file.problems import MAX_PROBLEMS

PARK = (index.FOLDER / "robotic-park.toml").read_text("utf-8")
RESOLVED = write_json(read("robotic-park").plan).decode()
SMALL = 'title = "x"\nduration_s = 1.0\n[robots.K]\nkind = "khepera4"\nstart = [0, 0]\n'
VALUES = [
    "nan", "inf", "-1", "1e400", "true", '""', '"KH01"', "[]", "{}", "[[]]", "[{}]", "1979-05-27", "9" * 30,
    "{ kind = [] }", '{"" = 1}',
]  # fmt: skip
TOKENS = st.sampled_from([
    *VALUES, "0", "[[1]]", "07:32:00", "'''x'''", '"\\u0000"', "=", ".", "]", "[", "#", "}", ",", "é", "kind",
    "robots", "0x" + "f" * 30, "{ kind = 3 }", "\x0b", "\u2028",
])  # fmt: skip
KEYS = st.sampled_from([
    "robots", "CF01", "trigger", "kind", "threshold", "formation", "links", "law", "timeline", "0", "plan",
    "cases", "event", "start", "rates", "gain", "'", "99", "²", "[0]", "TB01 > KH01", '"', "",
])  # fmt: skip
FLAGS = st.tuples(st.lists(KEYS, min_size=1, max_size=5).map(".".join), TOKENS | st.text(max_size=10)).map("=".join)


def reads_or_refuses(content, suffix=".toml", overrides=()):
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"some{suffix}"
        file.write_bytes(content)
        try:
            cases, refusal = read(file, overrides).cases(), None
        except DocumentError as error:
            cases, refusal = {}, error
    if refusal is None:
        assert cases
        assert all(write_json(case) for case in cases.values())
        return
    assert refusal.problems
    assert all(problem.message for problem in refusal.problems)
    assert all(str(problem) in str(refusal) for problem in refusal.problems[:MAX_PROBLEMS])
    assert str(refusal).encode("utf-8")


@st.composite
def mutated(draw, text):
    """A good file after some slips of the hand."""
    lines = text.split("\n")
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(lines) - 1))
        match draw(st.sampled_from(["delete", "repeat", "swap", "token", "insert", "cut", "join"])):
            case "delete":
                lines[at] = ""
            case "repeat":
                lines.insert(draw(st.integers(0, len(lines))), lines[at])
            case "swap":
                other = draw(st.integers(0, len(lines) - 1))
                lines[at], lines[other] = lines[other], lines[at]
            case "token":
                words = lines[at].split(" ")
                words[draw(st.integers(0, len(words) - 1))] = draw(TOKENS)
                lines[at] = " ".join(words)
            case "insert":
                column = draw(st.integers(0, len(lines[at])))
                lines[at] = lines[at][:column] + draw(TOKENS) + lines[at][column:]
            case "cut":
                lines[at] = lines[at][: draw(st.integers(0, len(lines[at])))]
            case "join":
                lines[at : at + 2] = [" ".join(lines[at : at + 2])]
    return "\n".join(lines)


@pytest.mark.slow
@settings(max_examples=300)
@given(mutated(PARK))
def test_mutations_of_a_good_file(text):
    reads_or_refuses(text.encode())


@pytest.mark.slow
@settings(max_examples=150)
@given(mutated(RESOLVED))
def test_mutations_of_a_good_json_file(text):
    reads_or_refuses(text.encode(), ".json")


@settings(max_examples=200)
@given(st.text(max_size=200).map(lambda text: text.encode("utf-8", "surrogatepass")) | st.binary(max_size=200),
       st.sampled_from([".toml", ".json"]))  # fmt: skip
def test_any_bytes(content, suffix):
    reads_or_refuses(content, suffix)


@pytest.mark.slow
@settings(max_examples=200)
@given(st.lists(FLAGS, max_size=3))
def test_any_override(overrides):
    reads_or_refuses(PARK.encode(), overrides=overrides)


@pytest.mark.slow
@pytest.mark.parametrize(
    "field", ["trigger", "robots", "cases", "timeline", "formation", "disturbance", "rates", "arena", "start"]
)
def test_any_value_for_any_field(field):
    for value in VALUES:
        for text in (f"{field} = {value}\n", f"cases.a.{field} = {value}\n"):
            reads_or_refuses((text + SMALL).encode())
            reads_or_refuses(text.encode())
        reads_or_refuses(PARK.encode(), overrides=[f"{field}={value}", f"cases.event.{field}={value}"])
