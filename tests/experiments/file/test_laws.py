"""Settings that go with a law that remembers, and settings that do not."""

import pytest

from agents.formation.link import BY_NOTHING
from experiments.catalogue import index
from experiments.check.check import check
from experiments.file import document
from experiments.file.problems import DocumentError

AVERAGE = index.find_file("average")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("formation.update=send-on-delta", "no function of its input alone"),
        ('architecture={ kind = "hybrid", robots = ["KH01"] }', "guided robots transmit no variables"),
        ("formation.anchors={ KH01 = 0.5 }", "'average' does not know them"),
        ("cases.event.trigger=relative", "'relative' judges errors of links"),
        ("cases.event.trigger=self-triggered", "does not see the variables"),
        ("formation.law=distance", "needs a target of every link"),
        ("formation.law=mixed", "give a distance, an offset or a bearing"),
    ],
)
def test_averaging_law_refuses_what_it_does_not_support(change, said):
    with pytest.raises(DocumentError, match=said):
        document.read(AVERAGE, [change])


def test_links_alone():
    plan = document.read(AVERAGE, ['formation.links={ "KH01 > KH04" = { from_s = 2.0 } }']).cases()["event"]
    (link,) = plan.one_way_links
    assert (link.sender, link.receiver, link.since, link.wanted.wants) == ("KH01", "KH04", 2.0, BY_NOTHING)


@pytest.mark.slow
def test_check_warns_of_words_that_are_lost():
    text = AVERAGE.read_text("utf-8").replace("duration_s = 30.0", "duration_s = 2.0")
    for given, warned in ((text, False), (text.replace(", maximum_silence_s = 1.0", ""), True)):
        assert ("lost-words" in {each.code for each in check(document.loads(given))}) is warned
