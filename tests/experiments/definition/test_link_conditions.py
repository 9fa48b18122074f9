"""[channel] of a file: what it means for each link, by name."""

import numpy as np

from agents.network import channel_model
from experiments.definition import link_conditions
from experiments.definition.experiment import ChannelTable, LinkChannelTable, Outage
from experiments.definition.plan import Plan
from experiments.file.consistency.whole import consistency_faults
from tests.small import small

NAMES = ("A", "B", "C")
LINKS = {"A - B": 0.5, "A > C": 0.5, "B > C": 0.5}
ENDS = (("B", "A"), ("A", "B"), ("A", "C"), ("B", "C"))  # sender and receiver of each link


def planned(channel=None, **parts):
    return Plan(small(dict.fromkeys(NAMES, "khepera4"), LINKS, channel=channel or ChannelTable(), **parts))


def conditions(channel, seed=1, **how):
    return link_conditions.conditions_of(planned(channel), ENDS, seed, **how)


def test_default_delay_is_a_millisecond_or_nothing_really():
    assert [link.delay for link in conditions(ChannelTable())] == [0.001] * 4
    assert [link.delay for link in conditions(ChannelTable(), real=True)] == [0.0] * 4
    assert [link.delay for link in conditions(ChannelTable(delay_s=0.02), real=True)] == [0.02] * 4
    assert not link_conditions.models_network(planned())
    assert link_conditions.models_network(planned(ChannelTable(loss=0.1)))


def test_links_have_their_own():
    own = {"A > C": LinkChannelTable(loss=0.3, burst=4.0), "A - B": LinkChannelTable(delay_s=0.1, bandwidth=1e4)}
    made = conditions(ChannelTable(loss=0.1, jitter_s=0.01, queue_s=0.2, links=own))
    assert [link.key for link in made] == [channel_model.key(1, *names) for names in ENDS]  # by the seed
    assert [link.loss for link in made] == [0.1, 0.1, 0.3, 0.1]
    np.testing.assert_array_equal([link.burst for link in made], [np.nan, np.nan, 4.0, np.nan])
    assert [link.delay for link in made] == [0.1, 0.1, 0.001, 0.001]
    assert [link.bandwidth for link in made] == [1e4, 1e4, np.inf, np.inf]
    assert {(link.jitter, link.queue) for link in made} == {(0.01, 0.2)}


def test_outages_of_links_of_robots_and_of_all():
    outages = [
        Outage(from_s=1.0, until_s=2.0),
        Outage(from_s=3.0, links=["A > B", "B > C"]),
        Outage(from_s=4.0, until_s=5.0, robots=["B"]),
    ]
    every, some, of_robot = (1.0, 2.0), (3.0, np.inf), (4.0, 5.0)
    found = [[*link.outages] for link in conditions(ChannelTable(outages=outages))]
    assert found == [[every, of_robot], [every, some, of_robot], [every], [every, some, of_robot]]


def test_what_is_possible_is_accepted():
    own = {"A > B": LinkChannelTable(loss=0.1)}
    mixed = ChannelTable(loss=0.5, burst=2.0, links=own, outages=[Outage(from_s=0.0)])
    for channel in (mixed, ChannelTable(loss=1.0, burst=3.0)):
        assert list(consistency_faults(planned(channel))) == []


def test_links_of_avoidance_alone_are_links():
    channel = ChannelTable(links={"C > A": LinkChannelTable(loss=0.5)})
    plan = planned(channel, avoidance={"kind": "potential", "hears": "all"})
    assert list(consistency_faults(plan)) == []
    links = plan.pose_links
    ends = [(NAMES[j], NAMES[i]) for i, j in zip(links.receiver, links.sender, strict=True)]
    made = link_conditions.conditions_of(plan, ends, 1)
    assert [pair for pair, link in zip(ends, made, strict=True) if link.loss] == [("C", "A")]
