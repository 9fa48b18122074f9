"""Every time, exit code and guarantee of three pages is told by a test, and every test that is named is there."""

import re

import pytest

from tests.conftest import ROOT
from tests.simulated.promises import PAGES, PROMISE

TEST = re.compile(r"([\w/]+\.py)::(test_\w+)(?:\[([\w-]+)\])?")


def page(name):
    return (ROOT / "docs" / f"{name}.md").read_text("utf-8")


@pytest.mark.parametrize("name", PAGES)
def test_every_promise_is_in_the_table(name):
    text = page(name)
    missing = [words for words in PAGES[name] if text.count(words) != 1]
    assert not missing, "words that the page has not, or more than once"
    places = [(text.index(words), text.index(words) + len(words)) for words in PAGES[name]]
    promises = [found.span() for found in PROMISE.finditer(text)]
    untold = [text[a:b] for a, b in promises if not any(begin < b and a < end for begin, end in places)]
    assert not untold, "add them to tests/simulated/promises.py, with the tests that break when they do not hold"
    idle = [text[begin:end] for begin, end in places if not any(begin < b and a < end for a, b in promises)]
    assert not idle, "these words promise no time, exit code or guarantee"


@pytest.mark.parametrize("name", PAGES)
def test_every_named_test_exists(name):
    for words, tests in PAGES[name].items():
        found = TEST.findall(tests)
        assert found or "::" not in tests, words
        for file, function, row in found:
            text = (ROOT / "tests" / file).read_text("utf-8")
            assert f"def {function}(" in text, f"{words}: {file}::{function}"
            assert not row or f'"{row}"' in text, f"{words}: {file}::{function}[{row}]"
