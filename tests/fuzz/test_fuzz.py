"""No traceback escapes from spoilt inputs, a few hundred each, nor from those in `once`, which did so once."""

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
        if file.stat().st_size > HUGE:
            yield pytest.param(file, SHORT, id=f"{file.stem}-begins")
        yield pytest.param(file, None, id=file.stem, marks=[pytest.mark.nightly] * (file.stat().st_size > HUGE))


@pytest.mark.parametrize(("file", "size"), list(once()))
def test_what_escaped_once_does_not_again(file, size):
    assert replay(file, size)


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
    assert 0 < tally.refused < tally.inputs == 300
    assert [way.rpartition(":")[0] for way in tally.kept] == ["IndexError in test_fuzz.py"]
