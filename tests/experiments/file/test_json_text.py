"""What stands behind a flag as JSON is the struct that it must be, or the place and the remedy are said."""

import pytest

from experiments.file.problems import DocumentError
from experiments.file.structure import OBJECT, parse_object
from twins.devices.device import Faults
from twins.scene import Obstacle


def test_an_object_is_read():
    assert parse_object("--device", '{"rc_hz": 20.0}') == {"rc_hz": 20.0}
    assert parse_object("--faults", '{"loss": 0.05}', Faults) == {"loss": 0.05}
    assert parse_object("--faults", "{}", Faults) == {}


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[1]", f"is no JSON object\n  {OBJECT}"),
        ("", f"is not JSON: Input data was truncated\n  {OBJECT}"),
        ('{"radius": }', f"is not JSON: invalid character (byte 11)\n  {OBJECT}"),
        ("[" * 6000, f"is not JSON: maximum recursion depth exceeded while deserializing an object\n  {OBJECT}"),
        ('{"radius": -1}', "'radius' must be a number > 0, not -1\n  of a cylinder [m]"),
    ],
)
def test_what_is_wrong_is_said_with_the_remedy(text, why):
    with pytest.raises(DocumentError) as refused:
        parse_object("--obstacle", text, Obstacle)
    assert str(refused.value).endswith(f": {why}")
    assert str(refused.value).startswith("--obstacle ")


def test_everything_that_is_wrong_is_said():
    with pytest.raises(DocumentError) as refused:
        parse_object("--faults", '{"los": 1, "battery": "full"}', Faults)
    assert [problem.message for problem in refused.value.problems] == [
        "unknown key 'los'",
        "'battery' must be a number, not 'full'",
    ]
