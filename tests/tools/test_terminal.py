"""Text of others in the terminal."""

from __future__ import annotations

import sys

import pytest

from tools.options import print_result, warn
from tools.terminal import printable, say

ESCAPES = "\x1b]0;owned\x07\x1b[2J\r\x9b2J\u202e"


def test_printable_escapes_what_steers_the_terminal() -> None:
    assert printable(ESCAPES).isprintable()
    assert printable("Böhm 1 234 → δ [m²]\u202f–") == "Böhm 1 234 → δ [m²]\u202f–"


@pytest.mark.parametrize(
    "tell",
    [
        lambda: say(f"a{ESCAPES}\nb"),
        lambda: say(f"a{ESCAPES}\nb", to=sys.stderr),
        lambda: warn([f"a{ESCAPES}\nb"]),
        lambda: print_result({}, f"a{ESCAPES}\nb", as_json=False),
    ],
)
def test_no_escape_reaches_the_terminal(tell, capsys) -> None:
    tell()
    printed = "".join(capsys.readouterr())
    assert not {"\x1b", "\x07", "\x9b", "\r", "\u202e"} & set(printed)
    assert printed.count("\n") == 2
