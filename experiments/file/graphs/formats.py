"""Formats of files with graphs: GraphML, edge lists and adjacency matrices as CSV. Errors name the line."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import isfinite
from typing import Final, Literal, NamedTuple
from xml.parsers import expat

Numbers = Mapping[str, float]
Rows = Literal["receivers", "senders"]

NUMBERS: Final = ("weight", "distance", "gain", "from_s", "until_s")  # attributes of an edge that are read
LABELS: Final = ("label", "name")  # attributes of a node that may be the name of a robot
SIGNS: Final = (">", "-")  # signs of a link
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
        return _graphml(text)
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
    return [_edge(number, row, directed=directed) for number, row in cells if not _is_header(row)]


def _cells(line: str) -> list[str]:
    sign = next((sign for sign in (",", ";", "\t") if sign in line), None)
    return [cell.strip().strip('"') for cell in line.split(sign)]


def _is_number(text: str) -> bool:
    try:
        return isfinite(float(text))
    except ValueError:
        return False


def _is_header(cells: Sequence[str]) -> bool:
    return [cell.lower() for cell in cells[:2]] in (["source", "target"], ["from", "to"], ["sender", "receiver"])


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
        found = re.findall(r"['\"](\w+)['\"]\s*:\s*([-+.\deE]+)", rest)
        return Edge(
            words[0], words[1], directed, {name: float(value) for name, value in found if _is_number(value)}, line
        )
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
    """State of the parser of a GraphML file."""

    keys: dict[str, str] = field(default_factory=dict)  # names of attributes by their id
    labels: dict[str, str] = field(default_factory=dict)  # name of a node by its id
    edges: list[Edge] = field(default_factory=list)
    directed: bool = False  # what edges are that do not say it
    attribute: str = ""  # name of the attribute that is open
    node: str = ""  # id of the node that is open
    text: str = ""


def _graphml(text: str) -> list[Edge]:
    """Edges of a GraphML file; a node is named by its id, or by its label."""
    seen, parser = _GraphML(), expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        name, seen.text = tag.rpartition(":")[2], ""
        if name == "key":
            seen.keys[attributes.get("id", "")] = attributes.get("attr.name", "").lower()
        elif name == "graph":
            seen.directed = attributes.get("edgedefault") == "directed"
        elif name == "node":
            seen.node = attributes.get("id", "")
        elif name == "data":
            seen.attribute = seen.keys.get(attributes.get("key", ""), "")
        elif name == "edge":
            source, target = attributes.get("source", ""), attributes.get("target", "")
            line, given = parser.CurrentLineNumber, attributes.get("directed")
            if not source or not target:
                raise GraphError(f"line {line}: an edge without source and target; give both")
            directed = seen.directed if given is None else given == "true"
            seen.edges.append(Edge(source, target, directed, {}, line))

    def end(tag: str) -> None:
        name, value = tag.rpartition(":")[2], seen.text.strip()
        if name == "node":
            seen.node = ""
        elif name == "data" and seen.node and seen.attribute in LABELS:
            seen.labels[seen.node] = value
        elif name == "data" and not seen.node and seen.edges and seen.attribute in NUMBERS:
            edge = seen.edges[-1]
            if not _is_number(value):
                raise GraphError(f"line {edge.line}: its {seen.attribute} {value[:40]!r} is no number; mend it")
            seen.edges[-1] = edge._replace(numbers={**edge.numbers, seen.attribute: float(value)})

    def data(words: str) -> None:
        seen.text += words

    def refuse(*_: object) -> None:
        raise GraphError(f"line {parser.CurrentLineNumber}: a DOCTYPE or an entity, which no graph needs; remove it")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = data, refuse
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        message = expat.ErrorString(error.code)
        raise GraphError(
            f"line {error.lineno}: it is no XML: {message}; write it again with the tool it is from"
        ) from None
    if not seen.edges:
        raise GraphError("it holds no edge; GraphML has <edge source=... target=...> in <graph>")
    names = seen.labels
    return [
        edge._replace(sender=names.get(edge.sender, edge.sender), receiver=names.get(edge.receiver, edge.receiver))
        for edge in seen.edges
    ]


def repeated(edges: Sequence[Edge]) -> tuple[Edge, Edge] | None:
    """Two edges between the same robots in the same direction, of which one says nothing; None if there are none."""
    pairs = sorted(
        ((ends, edge) for edge in edges for ends in _directions(edge)), key=lambda each: (each[0], each[1].line)
    )
    return next(((a, b) for (ends, a), (again, b) in pairwise(pairs) if ends == again), None)


def _directions(edge: Edge) -> list[tuple[str, str]]:
    ends = edge.sender, edge.receiver
    return [ends] if edge.directed or edge.sender == edge.receiver else [ends, ends[::-1]]
