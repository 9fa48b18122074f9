"""Helpers of several commands: pages are opened in the browser."""

import webbrowser

import pytest

from tools.options import open_in_browser


@pytest.mark.parametrize("opened", [True, False])
def test_page_is_named_where_no_browser_opens_it(opened, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(webbrowser, "open", lambda address: asked.append(address) or opened)
    open_in_browser("file:///report.html")
    assert asked == ["file:///report.html"]
    assert ("open file:///report.html by hand" in capsys.readouterr().err) is not opened
