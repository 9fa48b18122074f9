"""`./zenpark view` and `./zenpark run --view`: what cannot be viewed is refused before anything starts."""

from __future__ import annotations

import sys

import pytest

from tools.main import main


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("run", "triangle", "--pace", "2"), "--pace: only for --virtual --view"),
        (("run", "triangle", "--virtual", "--pace", "2"), "add both, or leave it out"),
        (("run", "triangle", "--virtual", "--view", "--seeds", "3"), "leave out --view or --seeds"),
        (("view", "nowhere"), "nowhere: holds no recording"),
        (("view", "--connect", "localhost"), "'localhost' is not an endpoint"),
        (("view",), "no run is up on this machine"),
    ],
)
def test_refusals(arguments, said, monkeypatch, capsys):
    pytest.importorskip("viser", reason="needs viser")
    monkeypatch.setattr(sys, "argv", ["zenpark", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    printed = capsys.readouterr()
    assert ended.value.code == 2, printed
    assert said in printed.err
    assert "Traceback" not in printed.err
