"""Terminal and options of the command line."""

from __future__ import annotations

import sys
import webbrowser

import pytest

from tools.options import open_in_browser, print_result, warn
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


@pytest.mark.parametrize("opened", [True, False])
def test_page_is_named_where_no_browser_opens_it(opened, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(webbrowser, "open", lambda address: asked.append(address) or opened)
    open_in_browser("file:///report.html")
    assert asked == ["file:///report.html"]
    assert ("open file:///report.html by hand" in capsys.readouterr().err) is not opened
