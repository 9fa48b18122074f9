import csv
import math
import re
import shutil
from types import SimpleNamespace
from unittest.mock import Mock

import networkx as nx
import numpy as np
import pytest
from PIL import Image

from agents.errors import ExplainedError
from experiments.definition.experiment import Formation, LinkTable
from experiments.definition.graph import adjacency
from experiments.metrics.signals import Measurement
from experiments.report import export
from experiments.report.export import UNITS, converted, matlab_names, structure
from experiments.report.page import Table, TableRow
from experiments.report.typeset import latex, markdown
from tests.runs import fly, recorded
from tests.small import small
from tools.commands import results as commands

scipy_io = pytest.importorskip("scipy.io")


@pytest.fixture(scope="module")
def recorded_run(tmp_path_factory):
    """The folder of a run of the first experiment, 4 s of it, and the run."""
    run = recorded("triangle", "duration_s=4.0", "timeline=[]")
    return shutil.copytree(run.folder, tmp_path_factory.mktemp("runs") / "run"), run


@pytest.mark.slow
def test_film_shows_the_run_from_start_to_end(recorded_run):
    file = recorded_run[0] / "film.gif"
    commands.export(str(recorded_run[0]), video=file, speed=20.0)
    with Image.open(file) as film:
        assert film.n_frames == math.ceil(4.0 / (20.0 / export.FRAMES_HZ))
        pictures = []
        for frame in (0, film.n_frames - 1):
            film.seek(frame)
            pictures.append(np.asarray(film.convert("RGB"), dtype=float))
    assert np.abs(pictures[1] - pictures[0]).mean() > 0.5  # the robots are elsewhere


def test_a_failing_encoder_is_named(recorded_run, tmp_path, monkeypatch):
    broken = tmp_path / "ffmpeg"
    broken.write_text("#!/bin/sh\nread -r _ && echo 'Unknown encoder' >&2\nexit 8\n")
    broken.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    with pytest.raises(ExplainedError, match="ffmpeg failed: Unknown encoder"):
        commands.export(str(recorded_run[0]), video=tmp_path / "film.mp4", speed=400.0)


@pytest.fixture(scope="module")
def mat(recorded_run):
    """The run as it is read back from the file that the command writes."""
    commands.export(str(recorded_run[0]), None, as_csv=False)
    return scipy_io.loadmat(recorded_run[0] / "run.mat", simplify_cells=True)


def test_arrays_come_back_as_they_were(recorded_run, mat):
    trace, read = recorded_run[1].traces["event"], mat["event"]
    assert set(mat) >= {"periodic", "event"}
    assert (read["case"], read["clock"], read["seed"]) == ("event", "virtual", 1.0)
    assert [*read["robots"], *read["kinds"]] == [*trace.robots, "khepera4", "khepera4", "crazyflie"]
    for name in ("time", "position", "yaw", "true_position", "goal", "setpoint"):
        assert read[name].dtype == float
        assert read[name] == pytest.approx(getattr(trace, name), abs=1e-6, nan_ok=True)  # through the recording
    assert read["error"] == pytest.approx(Measurement(trace).robot_errors, abs=1e-6)
    raw = scipy_io.loadmat(recorded_run[0] / "run.mat")["event"][0, 0]
    assert (raw["robots"].shape, raw["robots"].dtype, raw["time"].shape) == ((3, 1), object, (201, 1))


def test_metrics_of_files_have_names_for_matlab():
    found = export.converted({"way.py:Way": [1.0, None], "a_b": {"of file.py:Way": 2.0}})
    assert ([*found], [*found["a_b"]]) == (["way_py_Way", "a_b"], ["of_file_py_Way"])


def test_who_spoke_and_who_listens_count_from_one(recorded_run, mat):
    trace, read = recorded_run[1].traces["event"], mat["event"]
    sent, links, net = read["sent"], read["links"], trace.plan.links
    assert sent["time"] == pytest.approx(trace.sent.stamp, abs=1e-6)
    assert sent["position"] == pytest.approx(trace.sent.position, abs=1e-6)
    given = [sent["robot"], links["receiver"], links["sender"], links["distance"]]
    wanted = [trace.sent.link + 1.0, net.receiver + 1.0, net.sender + 1.0, net.distance]
    assert [each.tolist() for each in given] == [each.tolist() for each in wanted]
    assert read["adjacency"].tolist() == adjacency(net, 3).tolist()


def test_metrics_are_those_of_the_report(recorded_run, mat):
    measured, read = recorded_run[1].metrics["event"], mat["event"]["metrics"]
    assert list(read["robot"]) == [robot.robot for robot in measured.robots]
    iae = [robot.iae for robot in measured.robots]
    assert [*read["iae"], read["mean"]["itae"]] == pytest.approx([*iae, measured.mean["itae"]], rel=1e-6)
    assert np.isnan(read["impulse"]).all()  # nothing touched: unknown
    by_hand = np.bincount(mat["event"]["sent"]["robot"].astype(int))[1:] / 4.0
    assert read["f_hz"] == pytest.approx(by_hand)


def test_units_are_of_what_is_there(recorded_run, mat):
    def fits(units, values):
        for name, unit in units.items():
            if isinstance(unit, dict):
                fits(unit, values[name])
            elif name not in ("relative", "bearing"):  # only where links ask for them
                assert name in values
            assert re.fullmatch("[a-z][a-z0-9_]*", name)

    made = structure(recorded_run[1].traces["event"], recorded_run[1].metrics["event"])
    fits(UNITS, made)
    arrays = {name for name, value in made.items() if isinstance(value, np.ndarray) and value.dtype == float}
    assert arrays <= set(UNITS)
    assert mat["event"]["units"]["sent"]["velocity"] == "m/s"
    assert math.isnan(export.converted(None))
    assert export.converted([1, None, 2.5])[[0, 2]].tolist() == [1.0, 2.5]


def test_what_links_ask_for_besides_distances_is_told():
    formation = Formation(law="displacement", links={"KH01 > KH02": LinkTable(offset=(0.8, 0.1))})
    run = fly(small({"KH01": "khepera4", "KH02": "khepera4"}, formation=formation, duration_s=1.0))
    made = structure(run.trace, run.metrics)
    ends = [made["links"][name].tolist() for name in ("receiver", "sender")]
    assert (ends, made["adjacency"].tolist()) == ([[2.0], [1.0]], [[0.0, 0.0], [1.0, 0.0]])
    assert [*nx.from_numpy_array(made["adjacency"].T, create_using=nx.DiGraph).edges] == [(0, 1)]
    assert made["links"]["relative"][0, :2].tolist() == [0.8, 0.1]  # KH02 from KH01


def test_table_has_a_line_per_robot_and_time(recorded_run, tmp_path):
    commands.export(str(recorded_run[0]), str(tmp_path / "way.csv"), as_csv=False)
    rows = list(csv.DictReader((tmp_path / "way.csv").read_text("utf-8").splitlines()))
    assert len(rows) == 2 * 201 * 3
    trace, last = recorded_run[1].traces["event"], rows[-1]
    numbers = [float(last[name]) for name in ("time", "true_z", "error")]
    wanted = [4.0, trace.true_position[-1, 2, 2], Measurement(trace).robot_errors[-1, 2]]
    assert (last["case"], last["robot"], numbers) == ("event", "CF01", pytest.approx(wanted, abs=1e-6))
    assert not any("nan" in row.values() for row in rows)


def test_names_are_valid_in_matlab():
    given = ["periodic", "5mm", "a.b", "a-b", "a_b_2", "a_b", "end", "case_end", "x" * 70, "x" * 71]
    found = ["periodic", "case_5mm", "a_b", "a_b_2", "a_b_2_2", "a_b_3", "case_end", "case_end_2"]
    assert list(matlab_names(given).values()) == [*found, "x" * 63, "x" * 61 + "_2"]


def test_variables_of_laws_are_not_lost(tmp_path):
    memory = {"_phase": 1.0, "a-b": 2.0, "a_b": 3.0, "λ": 4.0, "end": 5.0}
    scipy_io.savemat(tmp_path / "x.mat", {"s": converted({"case": "c", "memory": memory})})
    read = scipy_io.loadmat(tmp_path / "x.mat", simplify_cells=True)["s"]
    assert read == {"case": "c", "memory": {"case__phase": 1.0, "a_b_2": 2.0, "a_b": 3.0, "case__": 4.0, "end": 5.0}}


def test_what_cannot_be_exported_is_explained(recorded_run, tmp_path, monkeypatch):
    folder, run = recorded_run
    monkeypatch.setenv("PATH", str(tmp_path))
    for option, name, more, reason in (
        ("target", "run.txt", {}, r"run\.txt: is no name"),
        ("target", "run.mat", {"as_csv": True}, r"end with \.mat, \.csv"),
        ("target", "nowhere/run.mat", {}, "cannot be written: No such file or directory"),
        ("target", "nowhere/run.csv", {}, "cannot be written: No such file or directory"),
        ("video", "film.mp4", {}, "needs the program ffmpeg"),
        ("video", "film.avi", {}, r"\.mp4 or \.gif"),
    ):
        with pytest.raises(ExplainedError, match=reason):
            commands.export(str(folder), **{option: tmp_path / name}, **more)
    with pytest.raises(ExplainedError, match=r"periodic has 0\.0 GB"):
        export.write_mat(run.traces, run.metrics, tmp_path / "run.mat", most_bytes=1000)
    monkeypatch.setattr("experiments.run.reopen", lambda _folder: SimpleNamespace(traces={}))
    with pytest.raises(ExplainedError, match="nothing to export"):
        commands.export(str(tmp_path), None, as_csv=True)


def test_without_scipy_it_says_what_to_install(recorded_run, monkeypatch):
    monkeypatch.setattr(export, "import_module", Mock(side_effect=ModuleNotFoundError("scipy.io")))
    with pytest.raises(ExplainedError, match=r"\./zenpark install scipy"):
        commands.export(str(recorded_run[0]), None, as_csv=False)
    commands.export(str(recorded_run[0]), None, as_csv=True)


TABLE = Table(
    ("Robot", "IAE [m s]"), (TableRow((("KH_1", "khepera4"), "1 ± 2")), TableRow(("mean", "−3"), sum=True)), title="a|b"
)


def test_latex_is_a_booktabs_table_with_signs_escaped():
    lines = latex([TABLE, Table(("empty",), ())]).splitlines()
    assert lines[2:4] == [r"\caption{Robots, a|b.}", r"\label{tab:robots-a-b}"]
    head = [r"\begin{tabular}{lr}", r"\toprule", r"Robot & IAE [m s] \\", r"\midrule"]
    assert lines[5:11] == [*head, r"KH\_1 khepera4 & 1 $\pm$ 2 \\", r"\midrule"]
    assert (lines[11:14], len(lines)) == ([r"mean & $-$3 \\", r"\bottomrule", r"\end{tabular}"], 16)
    assert latex([TABLE], width=7.16).count("{table*}") == 2


def test_signs_of_users_are_safe_in_latex():
    table = Table(
        ("[m] a_b", "minimum_interval_s"), (TableRow(("50 % & #1_~^\\", "0.1")),), title="{σ} $λ → x", note="α ± β"
    )
    text = latex([table])
    assert text.isascii()
    assert {
        r"{}[m] a\_b & minimum\_interval\_s \\",
        r"50 \% \& \#1\_\textasciitilde{}\textasciicircum{}\textbackslash{} & 0.1 \\",
        r"\caption{{}[m] a\_bs, \{$\sigma$\} \$$\lambda$ $\to$ x. $\alpha$ $\pm$ $\beta$}",
    } <= {*text.splitlines()}


def test_markdown_is_a_pipe_table():
    head = ["**a|b**", "", "| Robot | IAE [m s] |", "|---|---:|"]
    assert markdown([TABLE]).splitlines() == [*head, r"| KH\_1 khepera4 | 1 ± 2 |", "| mean | −3 |"]
