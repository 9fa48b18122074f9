"""Report of a modelled network: dropped poses and delays, link by link."""

import numpy as np
import pytest

from experiments.definition.experiment import ChannelTable, LinkChannelTable
from experiments.metrics.measure import measure
from experiments.recording import playback
from experiments.report import report
from experiments.report.page import number
from experiments.report.tables import network_tables, proof_tables, whole_tables
from experiments.report.verdict import findings
from tests.experiments.traces import pair
from tests.runs import fly
from tests.small import changed, reference

pytestmark = pytest.mark.slow  # runs and reports, whole

BAD = ChannelTable(delay_s=0.05, loss=0.2, links={"TB01 > KH01": LinkChannelTable(loss=0.0, delay_s=0.03)})


@pytest.fixture(scope="module")
def dropping_run():
    return fly(changed(reference("periodic"), duration_s=4.0, timeline=[], channel=BAD), case="bad")


def test_dropped_differs_from_lost(dropping_run):
    measured = dropping_run.metrics
    assert measured.modelled
    assert measured.lost == 0
    links = {(each.sender, each.receiver): each for each in measured.link_deliveries}
    assert len(links) == 21
    spared = links["TB01", "KH01"]
    assert (spared.dropped, spared.received) == (0, 200)  # that of the end is under way; one from before the start came
    assert (spared.delay_mean, spared.delay_max) == (pytest.approx(0.03), pytest.approx(0.03))
    for ends, each in links.items():
        if ends != ("TB01", "KH01"):
            assert each.dropped == pytest.approx(40, abs=24)
            assert each.received + each.dropped == pytest.approx(200, abs=4)
            assert each.delay_mean == pytest.approx(0.05)
    assert measured.dropped == sum(each.dropped for each in measured.link_deliveries)
    of = {robot.robot: robot.dropped for robot in measured.robots}
    assert of["TB01"] == sum(each.dropped for ends, each in links.items() if ends[0] == "TB01")
    assert sum(of.values()) == measured.dropped


def test_verdict_and_tables_have_dropped_poses(dropping_run):
    measured = dropping_run.metrics
    said = [each.text for each in findings([measured])]
    assert any(text.startswith("No pose was lost") for text in said)
    (text,) = [text for text in said if text.startswith("The modelled network dropped")]
    assert f"dropped {measured.dropped} of 4" in text
    assert text.endswith("at most 50.0 ms.")
    (table,) = network_tables([measured])
    assert table.rows[-1].cells[0] == "all"
    spared = next(row.cells for row in table.rows if row.cells[0] == "TB01 > KH01")
    assert spared == ("TB01 > KH01", "200", "0", "0", "30.0", "30.0")
    assert proof_tables([measured])[0].head[-2:] == ("Lost", "Dropped")
    dropped = ("Dropped", number(measured.dropped))
    assert dropped in [row.cells for table in whole_tables([measured]) for row in table.rows]


def test_report_has_network_section(tmp_path, dropping_run):
    text = report.write(tmp_path, [dropping_run.trace]).read_text(encoding="utf-8")
    assert "Network model" in text
    assert "TB01 &gt; KH01" in text


def test_plain_network_has_no_section():
    measured = measure(pair(np.ones(100)))
    assert not measured.modelled
    assert measured.dropped == 0
    assert network_tables([measured]) == ()
    assert proof_tables([measured])[0].head[-1] == "Lost"
    assert not any("modelled" in each.text for each in findings([measured]))


def test_recording_keeps_dropped_poses(tmp_path, dropping_run):
    dropping_run.recorder.record(tmp_path / "bad.mcap", "")
    read, trace = playback.read(tmp_path / "bad.mcap").trace, dropping_run.trace
    assert trace.dropped.sum() > 500
    np.testing.assert_array_equal(read.dropped, trace.dropped)
    np.testing.assert_array_equal(read.lost, 0)
    one, other = measure(read).link_deliveries, measure(trace).link_deliveries
    for a, b in zip(one, other, strict=True):
        assert (a.received, a.dropped) == (b.received, b.dropped)
        assert a.delay_mean == pytest.approx(b.delay_mean, abs=1e-5)
