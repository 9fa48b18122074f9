"""Commands that say what there is: explain a key, list ready-made experiments and plug-ins."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Final

import typer
from typer import Argument, Option

from agents.errors import did_you_mean
from experiments.catalogue import index
from tools.options import WIDEST, AsJson, example, print_json, print_result, warn

if TYPE_CHECKING:
    from experiments.file.reference import Entry

app: Final = typer.Typer()

LISTED: Final = 6  # keys about a word that is no key


@app.command(epilog=example("explain", "explain disturbance.hover_jitter", "explain plan.circle"))
def explain(
    key: Annotated[
        str, Argument(help="such as disturbance.hover_jitter, circle, my_laws.py:Spring; none: all at the top")
    ] = "",
    *,
    schema: Annotated[bool, Option("--schema", help="Print the JSON schema of the experiment file instead.")] = False,
    as_json: AsJson = False,
) -> int:
    """Explain a key of the experiment file, a plug-in, a kind of robot or a metric: text, unit, limits, an example."""
    from agents.plugins import files
    from experiments.file import json_schema, reference
    from experiments.metrics.metric import FIGURES, known_metrics, short_name

    warn(json_schema.unusable())
    if schema:
        print_json(json_schema.schema())
        return 0
    found = reference.matching(key) if key else reference.tables()
    if files.is_choice(key):
        found = reference.in_file(key)
    metric = {short_name(name): each for name, each in (FIGURES | known_metrics()).items()}.get(short_name(key.lower()))
    if not found and metric is not None:
        print_result(
            {"label": metric.label, "unit": metric.unit, "meaning": metric.meaning},
            *(
                f"metric: {metric.head}",
                textwrap.fill(metric.meaning, WIDEST, initial_indent="  ", subsequent_indent="  "),
            ),
            as_json=as_json,
        )
        return 0
    if not found:
        table, words = key.partition(".")[0], [".".join(entry.words) for entry in reference.entries()]
        listed = [] if "." in key else reference.containing(key)[:LISTED]
        hint = f"`./zenpark explain{f' {table}' if reference.matching(table) else ''}` lists what there is"
        if (near := did_you_mean(key, words)).startswith("did you mean"):
            hint = near
        if key.lower() in {name.split("_")[0] for name in FIGURES}:
            hint, listed = "a metric of a run: `./zenpark docs`, page 'Metrics and CSV columns'", []
        warn([f"nothing in the experiment file is named {key!r}; {'keys about it:' if listed else hint}"])
        for entry in listed:
            print(textwrap.shorten(f"  {entry.key}  {entry.text}", WIDEST, placeholder=" ..."), file=sys.stderr)
        return 2
    if as_json:
        print_json(found)
        return 0
    if not key:
        _print_entries(found)
        return 0
    first = found[0].text
    alike = [entry for entry in found if entry.text == first and not entry.key.startswith(f"{found[0].key}.")]
    print("\n".join(entry.key for entry in alike), "\n")
    for paragraph in first.split("\n\n"):
        print(textwrap.fill(paragraph, WIDEST, initial_indent="  ", subsequent_indent="  "))
    rows = {"type": found[0].type, "limits": found[0].limits, "default": found[0].default}
    print(*(f"  {name:8} {text}" for name, text in rows.items() if text), sep="\n")
    print(textwrap.indent(f"\n{found[0].example}", "    "))
    rest = [entry for entry in found if entry not in alike]
    known = {(entry.key.removeprefix(alike[0].key), entry.text) for entry in rest if entry.key.startswith(alike[0].key)}
    for other in alike[1:]:  # a plug-in in another place has the same parameters
        again = f"{other.key}."
        rest = [e for e in rest if not e.key.startswith(again) or (e.key.removeprefix(other.key), e.text) not in known]
    if rest:
        print()
    _print_entries(rest)
    return 0


def _print_entries(entries: Sequence[Entry]) -> None:
    """Lines of a table, one for each entry at its top: cut at a terminal, in full for a file or a pipe."""
    below: dict[str, int] = {}  # entries that others hold, by the first of these
    for entry in entries:
        holder = next((key for key in below if entry.key.startswith((f"{key}.", f"{key}("))), None)
        below[holder or entry.key] = below[holder] + 1 if holder else 0
    for entry in (each for each in entries if each.key in below):
        default = f"default: {entry.default}" if entry.default else ""
        more = f"{below[entry.key]} keys below" if below[entry.key] else ""
        limits = "" if entry.limits.startswith("matches") else entry.limits
        known = ", ".join(filter(None, (limits, default, more)))
        text = f"{entry.key}  {entry.text}" + (f" [{known}]" if known else "")
        print(textwrap.shorten(text, WIDEST if sys.stdout.isatty() else len(text), placeholder=" ..."))
    if whole := next((key for key, count in below.items() if count), ""):
        name = whole.replace("(", ".").replace(")", "")
        print(f"\n`./zenpark explain {name}`, and so on, for the keys below; --json prints all {len(entries)}")


@app.command(name="list", epilog=example("list", "list --json"))
def list_(as_json: AsJson = False) -> None:
    """List the ready-made experiments and the plugins."""
    from agents.plugins import registry

    plugins = {
        "Kinds of robots": registry.ROBOTS,
        "Bodies": registry.BODIES,
        "Protocol twins": registry.DEVICES,
        "Triggers": registry.TRIGGERS,
        "Predictors": registry.PREDICTORS,
        "Laws": registry.LAWS,
        "Planners": registry.PLANNERS,
        "Avoidances": registry.AVOIDANCES,
        "Engines": registry.ENGINES,
        "Added metrics": registry.METRICS,
    }
    if registry.distributions():  # others' plug-ins may be unusable; to find out takes numpy, half a second
        from experiments.file import json_schema
        from experiments.metrics.metric import unusable_metrics

        warn([*json_schema.unusable(), *unusable_metrics()])
    experiments = index.titles()
    found = {title: registry.names(group) for title, group in plugins.items()}
    width = max(len(name) for name in experiments)
    print_result(
        {"experiments": [{"name": name, "title": title} for name, title in experiments.items()]}
        | {title.lower().replace(" ", "_"): names for title, names in found.items()},
        "Experiments (./zenpark run NAME, ./zenpark new NAME):",
        *(f"  {name:<{width}}  {title}" for name, title in experiments.items()),
        *(f"{title}: {', '.join(names) or 'none'}" for title, names in found.items()),
        as_json=as_json,
    )
