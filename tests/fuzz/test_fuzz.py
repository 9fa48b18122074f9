"""Nothing that arrives from outside escapes as a traceback: a few hundred spoilt inputs each, and those that once did.

`./zenpark test --all` tries a million; what it finds is added to the folder `once`.
"""

from pathlib import Path

import pytest

from tests.fuzz.fuzz import PLACES, drive, replay
from tests.fuzz.mutate import LARGEST, Mutator
from tests.fuzz.target import Target

ONCE = sorted((Path(__file__).parent / "once").glob("*.bin"))
HUGE = 30_000  # bytes, over which an input takes seconds: by night alone it is tried whole,
SHORT = 4_000  # by day its first bytes
HEAVY = {name for name, place in PLACES.items() if place.quick <= 60}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in HEAVY else name for name in PLACES]
)
def test_nothing_escapes(name):
    with PLACES[name].open() as target:
        tally = drive(target, PLACES[name].quick, name)
    assert not tally.escaped, "\n".join(text for _, text in tally.kept.values())
    assert tally.refused < tally.inputs, "no good example is read"


def once():
    """Inputs that escaped once, with the number of bytes to try."""
    for file in ONCE:
        size = file.stat().st_size
        yield pytest.param(file, size, id=file.stem, marks=[pytest.mark.nightly] * (size > HUGE))
        if size > HUGE:
            yield pytest.param(file, SHORT, id=f"{file.stem}-begins")


@pytest.mark.parametrize(("file", "size"), list(once()))
def test_what_escaped_once_does_not_again(file, size):
    assert replay(PLACES[file.name.partition("--")[0]], file.read_bytes()[:size])


def test_every_example_is_found_by_name():
    assert {file.name.partition("--")[0] for file in ONCE} <= set(PLACES)
    assert sum(place.inputs for place in PLACES.values()) >= 1_000_000


def test_inputs_repeat_with_the_seed_and_stay_short():
    examples = [b'{"a":[1,2.5,"x"]}', b'{"b":null}']
    first, second = (Mutator(examples, 3) for _ in range(2))
    made = [first.spoilt() for _ in range(500)]
    assert made == [second.spoilt() for _ in range(500)]
    assert len(set(made)) > 400
    assert max(map(len, made)) <= LARGEST


def test_what_escapes_is_told_with_its_place():
    def careless(data):
        return data[3] if len(data) < 10 else int(data)

    tally = drive(Target([b"123456"], careless, (ValueError,)), 300, 1, bombs=True)
    assert tally.inputs == 300
    assert tally.refused > 0
    (way,) = tally.escaped
    assert way.startswith("IndexError in test_fuzz.py")
    assert len(tally.kept) == 1
