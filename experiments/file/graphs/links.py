"""Links of a formation from the graph that it names."""

from __future__ import annotations

import pathlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import msgspec

from agents.errors import did_you_mean
from experiments.definition.experiment import GraphTable
from experiments.definition.links import pairs_or_none
from experiments.file.completion import ALONE, content_of
from experiments.file.graphs.formats import Edge, GraphError, read, repeated
from experiments.file.problems import Fault, Path

HERE: Path = ("formation", "graph")


def fill_from_graph(document: dict[str, Any], folder: pathlib.Path) -> tuple[list[Fault], dict[str, bytes]]:
    """Gives the formation, in place, the links of the graph that it names, and takes the name away.

    Links of the experiment file win over those of the graph. What is malformed otherwise is left for later checks.

    Returns:
        What is wrong, and the content of the file by its name.
    """
    formation = document.get("formation")
    if not isinstance(formation, dict) or formation.get("graph") is None:
        return [], {}
    try:
        table: GraphTable | str = msgspec.convert(formation["graph"], str | GraphTable)
    except msgspec.ValidationError:
        return [], {}
    graph = GraphTable(file=table) if isinstance(table, str) else table
    path = HERE if isinstance(table, str) else (*HERE, "file")
    robots, links = document.get("robots"), formation.setdefault("links", {})
    if not isinstance(robots, dict) or not isinstance(links, dict):
        return [], {}
    del formation["graph"]
    found = content_of(graph.file, folder, path)
    if not isinstance(found, bytes):
        return [found] if found is not None else [], {}
    text = found.decode("utf-8-sig", errors="replace").replace("\r\n", "\n")
    try:
        edges = read(text, list(robots), directed=graph.directed, rows=graph.rows)
    except GraphError as error:
        message, _, hint = str(error).partition("; ")
        return [Fault(path, f"{graph.file}, {message}", hint)], {}
    faults = [replace(each, path=path) for each in _faults(edges, robots, graph)]
    if not faults:
        given = {pair for link in links for pair in pairs_or_none(link)}
        added = {_text(edge): _target(edge, graph, formation) for edge in edges}
        links.update({link: to for link, to in added.items() if not given & {*pairs_or_none(link)}})
    return faults, {graph.file: found}


def _faults(edges: list[Edge], robots: Mapping[str, object], graph: GraphTable) -> Iterator[Fault]:
    for edge in edges:
        where = f"{graph.file}, line {edge.line}"
        for name in dict.fromkeys((edge.sender, edge.receiver)):
            if name not in robots:
                yield Fault((), f"{where}: no robot is called '{name}'", did_you_mean(name, robots))
        if edge.sender == edge.receiver:
            yield Fault((), f"{where}: '{edge.sender}' cannot receive from itself", "name two robots")
        for name in ("distance", "gain", *(["weight"] if graph.weight != "nothing" else [])):
            if (value := edge.numbers.get(name, 1.0)) <= 0.0:
                remedy = 'give a positive one, or write weight = "nothing" in graph'
                yield Fault((), f"{where}: the {name} {value:g} of a link", remedy)
    if again := repeated(edges):
        first, second = again
        message = f"{graph.file}, line {second.line}: the link of {second.sender} and {second.receiver} stands in line"
        yield Fault((), f"{message} {first.line} already", "remove one of the two")


def _text(edge: Edge) -> str:
    return f"{edge.sender} {'>' if edge.directed else '-'} {edge.receiver}"


def _target(edge: Edge, graph: GraphTable, formation: Mapping[str, Any]) -> object:
    """A link as the experiment file writes it: its numbers, and the target of the graph if it has no distance."""
    numbers = {name: value for name, value in edge.numbers.items() if name not in ("weight", graph.weight)}
    weight = edge.numbers.get(graph.weight, edge.numbers.get("weight"))
    if graph.weight != "nothing" and weight is not None and not (graph.weight == "gain" and weight == 1.0):
        numbers[graph.weight] = weight
    if "distance" in numbers:
        return numbers
    target = graph.target or ("shape" if formation.get("shape") else ALONE)
    if isinstance(target, float):
        return {"distance": target, **numbers}
    return numbers or target
