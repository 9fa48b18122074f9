"""Formats of files with graphs: GraphML, edge lists and adjacency matrices as CSV. Errors name the line."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import isfinite
from typing import Final, Literal, NamedTuple
from xml.parsers import expat

Numbers = Mapping[str, float]
Rows = Literal["receivers", "senders"]

NUMBERS: Final = ("weight", "distance", "gain", "from_s", "until_s")  # attributes of an edge that are read
LABELS: Final = ("label", "name")  # attributes of a node that may be the name of a robot
HEADS: Final = (("source", "target"), ("from", "to"), ("sender", "receiver"))  # columns with the ends of an edge
TYPE: Final = "type"  # column in which Gephi says whether an edge is directed
UNREAD: Final = ("", "id", "label", "timeset", TYPE)  # further columns of pandas and Gephi
SIGNS: Final = (">", "-")  # signs of a link
# entry of a dictionary of networkx
ATTRIBUTE: Final = re.compile(rf"['\"]({'|'.join(NUMBERS)})['\"]\s*:\s*([^\s,}}]+)")
SAME: Final = 1e-9  # difference of two weights that are equal
WHICH: Final = (
    'write rows = "receivers" where a row receives from its columns, as in a consensus law, or rows = "senders" where '
    "it sends to them, as networkx writes it"
)


class Edge(NamedTuple):
    """Edge of a graph, from `sender` to `receiver` or both ways."""

    sender: str
    receiver: str
    directed: bool
    numbers: Numbers  # attributes by name
    line: int


class GraphError(ValueError):
    """File that is no graph; the text has line and remedy, behind `; `."""


def read(text: str, robots: Sequence[str], *, directed: bool = False, rows: Rows | None = None) -> list[Edge]:
    """Edges of a file's text.

    Args:
        robots: Names, in the order of the rows of a matrix without names.
        directed: Whether the lines of an edge list are directed, from the first to the second.
        rows: What the rows of a matrix that is not symmetric do.

    Raises:
        GraphError: If it is none of the formats, or ends of an edge are missing.
    """
    if text.lstrip().startswith("<"):
        return _GraphML(expat.ParserCreate()).read(text, robots)
    lines = [(number, line.partition("#")[0].strip()) for number, line in enumerate(text.split("\n"), 1)]
    cells = [(number, _cells(line)) for number, line in lines if line]
    if not cells:
        raise GraphError("the file holds no edge; give one link in a line, such as A B")
    names = cells[0][1][-len(cells) + 1 :] if len(cells) > 1 else []
    square = len(cells[0][1]) in (len(cells) - 1, len(cells)) and len(cells) > 2
    if square and not any(map(_is_number, names)) and all(not cell or _is_number(cell) for cell in cells[1][1][1:]):
        return _matrix(cells[1:], names, rows)
    if all(_is_number(cell) for _, row in cells for cell in row):
        if len(cells) != len(robots):
            hint = "give one row for each robot, a line of names above them, or edges between names"
            raise GraphError(f"a matrix of {len(cells)} rows without names, and there are {len(robots)} robots; {hint}")
        return _matrix(cells, robots, rows)
    heads = [name.lower() for name in cells[0][1]]
    if ends := next((ends for ends in HEADS if {*ends} <= {*heads}), None):
        return _table(cells, heads, ends, directed=directed)
    return [_edge(number, row, directed=directed) for number, row in cells]


def _cells(line: str) -> list[str]:
    line, brace, attributes = line.partition("{")
    sign = next((sign for sign in (",", ";", "\t") if sign in line), None)
    return [cell.strip().strip('"') for cell in line.split(sign)] + [brace + attributes] * bool(brace)


def _is_number(text: str) -> bool:
    try:
        return isfinite(float(text))
    except ValueError:
        return False


def _table(
    cells: Sequence[tuple[int, list[str]]], heads: Sequence[str], ends: tuple[str, str], *, directed: bool
) -> list[Edge]:
    """Edges of a table with names above its columns, of which `ends` hold the robots."""
    if other := next((name for name in heads if name not in (*ends, *NUMBERS, *UNREAD)), None):
        raise GraphError(
            f"line {cells[0][0]}: nothing is known of a column {other!r}; name it {', '.join(NUMBERS)}, or remove it"
        )
    found = list[Edge]()
    for line, row in cells[1:]:
        given = {name: cell for name, cell in zip(heads, row, strict=False) if cell}
        sender, receiver = (given.get(end, "") for end in ends)
        if not sender or not receiver:
            raise GraphError(f"line {line}: no {ends[0] if receiver else ends[1]}; write the names of two robots")
        numbers = {name: _number(line, name, cell) for name, cell in given.items() if name in NUMBERS}
        one_way = given[TYPE].lower() == "directed" if TYPE in given else directed
        found.append(Edge(sender, receiver, one_way, numbers, line))
    return found


def _number(line: int, name: str, text: str) -> float:
    """Value of an attribute, in quotes or as numpy prints it, too."""
    text = text.strip("'\"")
    value = re.sub(r"^np\.\w+\((.*)\)$", r"\1", text)
    if not _is_number(value):
        raise GraphError(f"line {line}: its {name} {text[:40]!r} is no number; mend it")
    return float(value)


def _edge(line: int, cells: Sequence[str], *, directed: bool) -> Edge:
    """Edge of a line `A B`, `A B 0.6`, `A > B`, `A - B` or `A B {'weight': 0.6}` as networkx writes it."""
    words = [cell for cell in cells if cell]
    if len(words) == 1 or (len(words) > 1 and words[1] in SIGNS):
        words = [*re.split(r"\s*([>-])\s*", " ".join(words[:3]), maxsplit=1), *words[3:]]
        directed = ">" in words
        words = [word for word in words if word not in SIGNS]
    if len(words) < 2 or _is_number(words[0]) != _is_number(words[1]):
        raise GraphError(f"line {line}: {' '.join(cells)[:60]!r} is no edge; write two names and, if wanted, a weight")
    rest = " ".join(words[2:])
    if rest.startswith("{"):
        numbers = {name: _number(line, name, value) for name, value in ATTRIBUTE.findall(rest)}
        return Edge(words[0], words[1], directed, numbers, line)
    if len(words) > 3 or (rest and not _is_number(rest)):
        raise GraphError(f"line {line}: {rest[:40]!r} is no weight; write two names and, if wanted, a number")
    return Edge(words[0], words[1], directed, {"weight": float(rest)} if rest else {}, line)


def _matrix(cells: Sequence[tuple[int, list[str]]], names: Sequence[str], rows: Rows | None) -> list[Edge]:
    """Edges of a matrix with a row for each name, which may begin with that name."""
    named = not _is_number(cells[0][1][0])
    weight, line_of = dict[tuple[str, str], float](), dict[str, int]()
    for name, (line, row) in zip(names, cells, strict=False):
        numbers = row[1:] if named else row
        if len(numbers) != len(names):
            raise GraphError(f"line {line}: {len(numbers)} numbers in a row, and {len(names)} names; give one for each")
        if named and row[0] != name:
            raise GraphError(f"line {line}: the row of {row[0]!r} stands where that of {name!r} is due; sort the rows")
        line_of[name] = line
        for other, cell in zip(names, numbers, strict=True):
            if not _is_number(cell or "0"):
                raise GraphError(f"line {line}: {cell[:40]!r} is no weight; write 0 where there is no link")
            weight[name, other] = float(cell or 0.0)
    even = all(abs(weight[a, b] - weight[b, a]) <= SAME for a, b in weight)
    if not even and rows is None:
        raise GraphError(f"the matrix is not symmetric; {WHICH}")
    found = list[Edge]()
    for (name, other), value in weight.items():
        if value == 0.0 or (even and names.index(other) < names.index(name)):
            continue
        sender, receiver = (other, name) if rows == "receivers" else (name, other)
        found.append(Edge(sender, receiver, not even, {"weight": value}, line_of[name]))
    return found


@dataclass
class _GraphML:
    """Reader of a GraphML file; a node is named by its id, or by its label."""

    parser: expat.XMLParserType
    keys: dict[str, str] = field(default_factory=dict)  # names of attributes by their id
    defaults: dict[str, float] = field(default_factory=dict)  # numbers of edges that do not give them
    labels: dict[str, str] = field(default_factory=dict)  # name of a node by its id
    edges: list[Edge] = field(default_factory=list)
    directed: bool = False  # what edges are that do not say it
    attribute: str = ""  # name of the attribute that is open
    of_edges: bool = False  # True if the key that is open is for edges
    node: str = ""  # id of the node that is open
    tag: str = ""  # element of which `text` is the beginning
    text: str = ""

    def read(self, text: str, robots: Collection[str]) -> list[Edge]:
        """Edges of a file's text; an id that is the name of a robot is taken before a label that is none."""
        self.parser.StartElementHandler, self.parser.EndElementHandler = self._start, self._end
        self.parser.CharacterDataHandler, self.parser.StartDoctypeDeclHandler = self._data, self._refuse
        try:
            self.parser.Parse(text, True)
        except expat.ExpatError as error:
            message = expat.ErrorString(error.code)
            raise GraphError(
                f"line {error.lineno}: it is no XML: {message}; write it again with the tool it is from"
            ) from None
        if not self.edges:
            raise GraphError("it holds no edge; GraphML has <edge source=... target=...> in <graph>")
        found = list[Edge]()
        for edge in self.edges:
            sender, receiver = (self._name(node, robots) for node in edge[:2])
            found.append(Edge(sender, receiver, edge.directed, {**self.defaults, **edge.numbers}, edge.line))
        return found

    def _name(self, node: str, robots: Collection[str]) -> str:
        label = self.labels.get(node, node)
        return label if label in robots or node not in robots else node

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._keep_label()
        name, line = tag.rpartition(":")[2], self.parser.CurrentLineNumber
        if not self.tag and name != "graphml":
            hint = "export GraphML, as networkx.write_graphml does"
            raise GraphError(f"line {line}: <{name}> begins another format than GraphML; {hint}")
        self.tag, self.text = name, ""
        if name == "key":
            self.attribute, self.of_edges = attributes.get("attr.name", "").lower(), attributes.get("for") != "node"
            self.keys[attributes.get("id", "")] = self.attribute
        elif name == "graph":
            self.directed = attributes.get("edgedefault") == "directed"
        elif name == "node":
            self.node = attributes.get("id", "")
        elif name == "data":
            self.attribute = self.keys.get(attributes.get("key", ""), "")
        elif name == "edge":
            source, target = attributes.get("source", ""), attributes.get("target", "")
            if not source or not target:
                raise GraphError(f"line {line}: an edge without source and target; give both")
            given = attributes.get("directed")
            directed = self.directed if given is None else given == "true"
            self.edges.append(Edge(source, target, directed, {}, line))

    def _end(self, tag: str) -> None:
        self._keep_label()
        self.tag = tag
        name, value = tag.rpartition(":")[2], self.text.strip()
        if name == "node":
            self.node = ""
        elif name == "default" and self.of_edges and self.attribute in NUMBERS:
            self.defaults[self.attribute] = _number(self.parser.CurrentLineNumber, self.attribute, value)
        elif name == "data" and self.node and self.attribute in LABELS:
            self.labels[self.node] = value
        elif name == "data" and not self.node and self.edges and self.attribute in NUMBERS:
            edge = self.edges[-1]
            number = _number(edge.line, self.attribute, value)
            self.edges[-1] = edge._replace(numbers={**edge.numbers, self.attribute: number})

    def _keep_label(self) -> None:
        """Keeps the label that yEd draws on a node."""
        if self.tag == "NodeLabel" and self.text.strip():
            self.labels.setdefault(self.node, self.text.strip())

    def _data(self, words: str) -> None:
        self.text += words

    def _refuse(self, *_: object) -> None:
        line = self.parser.CurrentLineNumber
        raise GraphError(f"line {line}: a DOCTYPE or an entity, which no graph needs; remove it")


def repeated(edges: Sequence[Edge]) -> tuple[Edge, Edge] | None:
    """Two edges between the same robots in the same direction, of which one says nothing; None if there are none."""
    pairs = sorted(
        ((ends, edge) for edge in edges for ends in _directions(edge)), key=lambda each: (each[0], each[1].line)
    )
    return next(((a, b) for (ends, a), (again, b) in pairwise(pairs) if ends == again), None)


def _directions(edge: Edge) -> list[tuple[str, str]]:
    ends = edge.sender, edge.receiver
    return [ends] if edge.directed or edge.sender == edge.receiver else [ends, ends[::-1]]
