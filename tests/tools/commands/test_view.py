"""`./zenpark view` and `./zenpark run --view`: what cannot be viewed is refused before anything starts."""

from __future__ import annotations

import pytest

from tests.tools.test_cli import zenpark


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("run", "triangle", "--pace", "2"), "--pace: is for --virtual --view"),
        (("run", "triangle", "--virtual", "--pace", "2"), "add both, or leave it out"),
        (("run", "triangle", "--virtual", "--view", "--seeds", "3"), "leave out --view or --seeds"),
        (("view", "nowhere"), "nowhere: holds no recording"),
        (("view", "--connect", "localhost"), "'localhost' is not an endpoint"),
        (("view",), "no run is up on this machine"),
    ],
)
def test_refusals(arguments, said):
    pytest.importorskip("viser", reason="needs viser")
    done = zenpark(*arguments)
    assert done.returncode == 2, done.stderr
    assert said in done.stderr
    assert "Traceback" not in done.stderr
