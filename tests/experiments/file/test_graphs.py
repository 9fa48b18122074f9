"""Links from graphs in files: those that networkx writes, and those of people; directions and weights as in a file."""

import networkx as nx
import numpy as np
import pytest

from experiments.definition.experiment import LinkTable
from experiments.file import document
from experiments.file.problems import DocumentError

ROBOTS = """title = "Graph"
duration_s = 5.0
[robots]
A = { kind = "khepera4", start = [0.0, 0.0] }
B = { kind = "khepera4", start = [0.8, 0.0] }
C = { kind = "khepera4", start = [0.8, 0.8] }
"""
BOTH, ONE_WAY = nx.Graph(), nx.DiGraph([("A", "B"), ("B", "C")])
BOTH.add_edge("A", "B", weight=1.0)
BOTH.add_edge("B", "C", weight=2.0)
BOTH.add_edge("A", "C", distance=0.9)
ALL = {"A - B": {"distance": 0.7}, "A - C": {"distance": 0.9}, "B - C": {"distance": 0.7, "gain": 2.0}}
SENT = {"A > B": {"distance": 0.7}, "B > C": {"distance": 0.7}}


@pytest.fixture
def links(tmp_path):
    """Links of an experiment with a graph; `write` makes the file, or is its text."""

    def read(write, options="", more=""):
        file = tmp_path / "net.graph"
        if callable(write):
            write(file)
        else:
            file.write_text(write)
        task = f'{ROBOTS}[formation]\ngraph = {{ file = "net.graph", target = 0.7{options} }}\n{more}'
        (tmp_path / "task.toml").write_text(task)
        given = document.read(tmp_path / "task.toml").experiment.formation.link_tables
        return {"- ".join(text.split("- ")): table for text, table in sorted(given.items())}

    return read


def expected(table):
    return {text: LinkTable(**fields) for text, fields in table.items()}


MATRIX = ",A,B,C\nA,0,1,\nB,0,0,1\nC,0,0,0\n"


@pytest.mark.parametrize(
    ("write", "options", "found"),
    [
        (lambda file: nx.write_graphml(BOTH, file), "", ALL),
        (lambda file: nx.write_edgelist(BOTH, file), "", ALL),
        (lambda file: nx.write_graphml(ONE_WAY, file), "", SENT),
        (lambda file: nx.write_edgelist(ONE_WAY, file, data=False), ", directed = true", SENT),
        (lambda file: np.savetxt(file, nx.to_numpy_array(ONE_WAY), delimiter=","), ', rows = "senders"', SENT),
        (lambda file: np.savetxt(file, nx.to_numpy_array(ONE_WAY).T), ', rows = "receivers"', SENT),
        (MATRIX, ', rows = "senders"', SENT),
        ("A,B,C\n0,1,0.5\n1,0,2\n0.5,2,0\n", ', weight = "distance"',
         {"A - B": {"distance": 1.0}, "A - C": {"distance": 0.5}, "B - C": {"distance": 2.0}}),
        ("# a list\nA > B 2\nB - C\n", "", {"A > B": {"distance": 0.7, "gain": 2.0}, "B - C": {"distance": 0.7}}),
        ("source;target;weight\nA;B;3\n", ', weight = "nothing"', {"A - B": {"distance": 0.7}}),
        (",target,source,distance\n0,A,B,0.5\n", ", directed = true", {"B > A": {"distance": 0.5}}),
        ("Source,Target,Type,Id,Label,timeset,Weight\nA,B,Directed,0,,,3.0\n", "",
         {"A > B": {"distance": 0.7, "gain": 3.0}}),
        ("A B {'colour': 'red', 'distance': '0.5'}\n", "", {"A - B": {"distance": 0.5}}),
    ],
)  # fmt: skip
def test_edges_are_the_links(write, options, found, links):
    assert links(write, options) == expected(found)


@pytest.mark.parametrize("write", [nx.write_edgelist, nx.write_graphml])
def test_numbers_of_numpy_are_read(write, links):
    graph = nx.Graph()
    graph.add_edge("A", "B", distance=np.linalg.norm([0.3, 0.4]))
    assert links(lambda file: write(graph, file)) == expected({"A - B": {"distance": 0.5}})


def test_defaults_of_graphml_are_those_of_its_edges(links):
    graph = nx.Graph([("A", "B"), ("B", "C", {"distance": 0.9})], edge_default={"distance": 0.5})
    found = links(lambda file: nx.write_graphml(graph, file))
    assert found == expected({"A - B": {"distance": 0.5}, "B - C": {"distance": 0.9}})


def test_links_of_the_experiment_win(links, tmp_path):
    found = links("A B\nB C\n", more='[formation.links]\n"B > A" = 0.3\n')
    assert found == expected({"B > A": {"distance": 0.3}, "B - C": {"distance": 0.7}})
    shape = "[formation.shape]\nA = [0.0, 0.0]\nB = [3.0, 4.0]\nC = [0.0, 1.0]\n"
    assert links("A B\n", ', weight = "gain"'.replace("gain", "nothing"), shape)["A - B"].distance == 0.7
    by_shape = (tmp_path / "task.toml").read_text().replace(", target = 0.7", "")
    (tmp_path / "task.toml").write_text(by_shape)
    read = document.read(tmp_path / "task.toml")
    assert read.experiment.formation.link_tables["A - B"].distance == pytest.approx(5.0)
    assert document.received(document.case_document(read.plan).decode(), "robot").experiment == read.experiment
    (tmp_path / "run").mkdir()
    read.keep(tmp_path / "run" / "experiment.toml")
    assert document.read(tmp_path / "run" / "experiment.toml").experiment == read.experiment


def graphml(edges, attributes=""):
    return f'<graphml>\n<graph edgedefault="undirected"{attributes}>\n{edges}\n</graph>\n</graphml>\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("A B\nA D\n", "net.graph, line 2: no robot is called 'D'|known: A, B, C"),
        ("A B\nB A\n", "line 2: the link of B and A stands in line 1 already|remove one"),
        ("A A\n", "line 1: 'A' cannot receive from itself"),
        ("A\n", "line 1: 'A' is no edge|two names"),
        ("A B heavy\n", "line 1: 'heavy' is no weight"),
        ("A B -1\n", "line 1: the weight -1 of a link|positive"),
        ("", "holds no edge"),
        (MATRIX, 'not symmetric|rows = "receivers"'),
        ("0,1\n1,0\n", "a matrix of 2 rows without names, and there are 3 robots"),
        (MATRIX.replace("A,0,1,", "A,0,1"), "line 2: 2 numbers in a row|names"),
        (MATRIX.replace("B,0", "C,0"), "line 3: the row of 'C' stands where that of 'B' is due"),
        (MATRIX.replace("B,0", "B,x"), "line 3: 'x' is no weight"),
        (graphml('<edge source="A" target="X"/>'), "line 3: no robot is called 'X'"),
        (graphml('<edge source="A"/>'), "line 3: an edge without source and target"),
        (graphml(""), "holds no edge"),
        ("\n".join(nx.generate_gexf(ONE_WAY)), "line 1: <gexf> begins another format than GraphML"),
        ("source,target,length\nA,B,2\n", "line 1: nothing is known of a column 'length'"),
        ("source,target\nA,\n", "line 2: no target"),
        ("A B {'weight': None}\n", "line 1: its weight 'None' is no number"),
        ("<graphml>\n<edge\n", "it is no XML"),
        ('<!DOCTYPE g [<!ENTITY a "b">]>\n<graphml/>', "line 1: a DOCTYPE"),
    ],
)
def test_other_files_are_refused_with_their_line(text, said, links, tmp_path):
    with pytest.raises(DocumentError) as raised:
        links(text)
    (problem,) = raised.value.problems
    assert all(word in str(problem) for word in said.split("|")), str(problem)
    assert problem.place == f"{tmp_path / 'task.toml'}:8:18"


YED = '<y:NodeLabel x="1.0">{}<y:LabelModel>\n</y:LabelModel></y:NodeLabel>'  # a label of yEd
LABELLED = '<node id="n0"><data key="d">{}</data></node><node id="n1"><data key="d">{}</data></node>'


@pytest.mark.parametrize("label", ["{}", YED])
def test_labels_of_nodes_name_the_robots(label, links):
    nodes = LABELLED.format(label.format("A"), label.format("C"))
    text = graphml(f'{nodes}<edge source="n0" target="n1" directed="true"/>')
    name = ' attr.name="label"' if label == "{}" else ""
    text = text.replace("<graphml>", f'<graphml xmlns:y="yEd"><key id="d" for="node"{name}/>')
    assert links(text) == expected({"A > C": {"distance": 0.7}})


def test_labels_that_are_no_robots_leave_the_ids(links):
    graph = nx.Graph([("A", "B")])
    nx.set_node_attributes(graph, {"A": "leader", "B": "left"}, "label")
    assert links(lambda file: nx.write_graphml(graph, file)) == expected({"A - B": {"distance": 0.7}})
