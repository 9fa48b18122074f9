"""Pages of the documentation site that are generated, the reference from the code's own texts; and its formulas.

A hook of mkdocs (`mkdocs.yml`): the pages exist only in the site. As a program it prints those that are named.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from html import unescape
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import click
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

NOTEBOOKS: Final = (
    "experiments.file.document",
    "experiments.run",
    "experiments.sweep.sweep",
    "experiments.recording.trace",
)
SOUGHT: Final = {
    "safety.md": 30,
    "first-flight.md": 8,
    "motion-capture.md": 4,
    "plugins.md": 2,
}  # weights in the search
FORMULA: Final = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
PLUGINS: Final = (
    "agents.vectors",
    "agents.formation.link",
    "agents.plugins.law",
    "agents.plugins.laws",
    "agents.plugins.triggers",
    "agents.plugins.predictors",
    "agents.plugins.planners",
    "agents.plugins.avoidance",
    "agents.body.kinds",
    "agents.body.interface",
    "experiments.metrics.metric",
    "experiments.metrics.signals",
    "twins.engines.engine",
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the generated pages."""
    from mkdocs.structure.files import File  # noqa: PLC0415

    for name, make in PAGES.items():
        files.append(File.generated(config, f"reference/{name}.md", content="\n".join(make())))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: object) -> str:
    """Pages that most questions are about come first in the search: safety before all others."""
    if weight := SOUGHT.get(page.file.src_uri):
        page.meta["search"] = {"boost": weight}
    return markdown


def on_page_content(html: str, **_: object) -> str:
    """Formulas as MathML, which browsers draw without a script."""
    from latex2mathml.converter import convert  # noqa: PLC0415

    displays = {"span": "inline", "div": "block"}
    return FORMULA.sub(lambda found: convert(unescape(found[2]).strip(), display=displays[found[1]]), html)


def experiment_file() -> Iterator[str]:
    """Every key of the experiment file."""
    from experiments.file import reference  # noqa: PLC0415

    yield "# The experiment file\n"
    yield (
        "Every table and key, with the plug-ins that come along. `./zenpark explain KEY` prints the same. Names in"
        " capitals stand for names of your own; a plug-in stands in parentheses. `[cases.NAME]` may override any key.\n"
    )
    entries = reference.entries()
    tops = list(dict.fromkeys(re.split(r"[.(]", entry.key)[0] for entry in entries))
    simple = [top for top in tops if not any(entry.key.startswith((f"{top}.", f"{top}(")) for entry in entries)]
    yield "## Top of the file\n"
    yield from _keys([entry for entry in entries if entry.key in simple], "")
    for top in tops:
        if top in simple:
            continue
        yield f"\n## `[{top}]`\n"
        whole, *below = (entry for entry in entries if re.split(r"[.(]", entry.key)[0] == top)
        yield f"{whole.text}\n"
        plain = [entry for entry in below if "(" not in entry.key]
        if plain:
            yield from _keys(plain, top)
        for number, entry in enumerate(below):
            if not entry.key.endswith(")"):
                continue
            yield f"\n### `{entry.key.rpartition('.')[2]}`\n"
            yield f"`{entry.key}`: {entry.text}\n"
            own = [each for each in below[number:] if each.key.startswith(f"{entry.key}.")]
            if own:
                yield from _keys(own, entry.key)


def _keys(entries: Sequence[Any], owner: str) -> Iterator[str]:
    yield from ("| key | meaning | value | default | example |", "|---|---|---|---|---|")
    for entry in entries:
        value = entry.type + (f", {entry.limits}" if entry.limits else "")
        default = _cell(f"`{entry.default}`") if entry.default else ("**required**" if entry.required else "–")
        example = "<br>".join(_cell(f"`{line}`") for line in entry.example.splitlines())
        key = entry.key.removeprefix(owner).lstrip(".")
        yield f"| `{key}` | {_cell(entry.text)} | {_cell(value)} | {default} | {example} |"


def _cell(text: str) -> str:
    parts = text.replace("\n\n", " ").replace("\n", " ").split("`")  # every second one is code, which stays as it is
    return "`".join(part if k % 2 else part.replace("|", "\\|").replace("<", "&lt;") for k, part in enumerate(parts))


def commands() -> Iterator[str]:
    """Every command with its options, and the exit codes."""
    import typer.main  # noqa: PLC0415

    from tools.main import app  # noqa: PLC0415
    from tools.options import PANELS  # noqa: PLC0415

    yield "# Commands\n"
    yield "`./zenpark COMMAND --help` prints the same.\n"
    yield "`./zenpark --install-completion` completes, in bash, commands, experiments, cases, robots, paths of `--set`"
    yield "and folders of runs; in zsh and fish where a `zenpark` is on the PATH. `ZENPARK_CONNECT` is the default"
    yield "of `--connect` (several routers with spaces between them).\n"
    yield from ("| exit code | meaning |", "|---|---|", "| 0 | done |", "| 1 | it ran, and something failed |")
    yield "| 2 | wrong input: the message names the place and the remedy |"
    yield "| 3 | a run was spoiled: its figures are compared with nothing ([why](../runs.md)) |"
    yield "| 130 | ended by Ctrl-C |\n"
    every = getattr(typer.main.get_command(app), "commands", {})
    for title, names in PANELS.items():
        yield f"\n## {title}\n"
        for name in names.split():
            yield from _command(every[name], f"./zenpark {name}", 3)


def _command(command: click.Command, name: str, depth: int) -> Iterator[str]:
    below = getattr(command, "commands", {})
    arguments = " ".join(str(part.name).upper() for part in command.params if not _is_option(part))
    yield f"\n{'#' * min(depth, 4)} {name.removeprefix('./zenpark ')}\n"
    yield f"    {name} {arguments}\n" if not below else ""
    yield f"{inspect.cleandoc(command.help or '')}\n"
    rows = [part for part in command.params if getattr(part, "help", None) and part.name != "help"]
    if rows:
        yield from ("| option | meaning | default |", "|---|---|---|")
        for part in rows:
            names = ", ".join(f"`{each}`" for each in part.opts) if _is_option(part) else f"`{part.name}`"
            plain = isinstance(part.default, int | float | str) and not isinstance(part.default, bool)
            default = part.default if plain else "on" if part.default is True else ""
            yield f"| {names} | {_cell(getattr(part, 'help', ''))} | {default} |"
    for child, each in below.items():
        if not each.hidden:
            yield from _command(each, f"{name} {child}", depth + 1)


def _is_option(part: click.Parameter) -> bool:
    return part.param_type_name == "option"


def metrics() -> Iterator[str]:
    """Metrics, which are the columns of metrics.csv and the fields of metrics.json."""
    from experiments.metrics import results  # noqa: PLC0415
    from experiments.metrics.metric import FIGURES  # noqa: PLC0415

    yield "# Metrics and CSV columns\n"
    yield (
        "`metrics.csv` has a row per case and robot and a row `mean` per case (over the robots with `in_mean` 1), with"
        " the fields of `RobotMetrics` as columns; those of a later phase begin with `phase2_`, of the closest approach"
        " with `near_` and `near_arena_`, of the shadow twin with `shadow_`. `metrics.json` has everything below;"
        " fields without a text are metrics of the first table.\n"
    )
    yield from ("| metric | head | definition |", "|---|---|---|")
    yield from (f"| `{name}` | {each.head} | {_cell(each.meaning)} |" for name, each in FIGURES.items())
    yield from _structs(results)


def recordings() -> Iterator[str]:
    """Topics and messages of a recording."""
    from experiments.recording import topics  # noqa: PLC0415

    yield "# Recordings\n"
    yield (
        "A recording is an [MCAP](https://mcap.dev) file with ROS 2 messages (CDR), their definitions included. Read"
        " one with `mcap-ros2-support`, `rosbags`, rerun or Foxglove, or with `experiments.recording.playback`. A"
        " message of zenpark has one field, `data`, the JSON that was on the network: `json.loads(message.data)`.\n"
    )
    yield from ("| topic | type | key on the network |", "|---|---|---|")
    from agents.network.keys import Keys  # noqa: PLC0415

    for topic in topics.TOPICS:
        yield f"| `{topic.name}` | `zenpark_msgs/{topic.message.__name__}` | `{topic.key(Keys())}` |"
    yield "\n" + (inspect.getdoc(topics) or "").partition("\n\n")[2] + "\n"
    yield from _structs(topics)


def network() -> Iterator[str]:
    """Network keys and the messages on them."""
    from agents.network import keys, messages  # noqa: PLC0415

    yield "# Network keys and messages\n"
    yield "Payloads are JSON unless their encoding says MessagePack. `park` is the realm (`[network] realm`).\n"
    yield from ("| key | meaning |", "|---|---|")
    made = keys.Keys()
    lines = inspect.getsource(keys).splitlines()
    (table,) = (each for each in ast.parse("\n".join(lines)).body if getattr(each, "name", "") == "Keys")
    for node in table.body:
        if isinstance(node, ast.Assign):
            key = getattr(made, ast.unparse(node.targets[0]))
            yield f"| `{key if isinstance(key, str) else key('CF01')}` | {_cell(_comment(node, lines))} |"
    yield ""
    yield from _structs(messages)


def _structs(module: ModuleType, level: int = 2, *, parameters: bool = True) -> Iterator[str]:
    """Structs of a module as tables below headings of a level; the text of a field is the comment at it, or above it.

    Those of `parameters` alone, which the reference of the experiment file has, are left out on request.
    """
    source = inspect.getsource(module)
    lines = source.splitlines()
    for node in ast.parse(source).body:
        if not isinstance(node, ast.ClassDef) or node.name.startswith("_"):
            continue
        fields = [each for each in node.body if isinstance(each, ast.AnnAssign)]
        if not (fields if parameters else [each for each in fields if _comment(each, lines)]):
            continue
        yield f"\n{'#' * level} {'' if parameters else 'Fields of '}{node.name}\n"
        yield f"{ast.get_docstring(node) or ''}\n"
        yield from ("| field | type | default | meaning |", "|---|---|---|---|")
        for each in fields:
            name, kind = ast.unparse(each.target), _cell(f"`{ast.unparse(each.annotation)}`")
            default = _cell(f"`{ast.unparse(each.value)}`") if each.value else "–"
            yield f"| `{name}` | {kind} | {default} | {_cell(_comment(each, lines))} |"


def _comment(node: ast.stmt, lines: Sequence[str]) -> str:
    """The comment beside a statement, or right above it."""
    above: list[str] = []
    number = node.lineno - 2
    while lines[number].strip().startswith("#"):
        above.insert(0, lines[number].strip(" #"))
        number -= 1
    beside = lines[(node.end_lineno or node.lineno) - 1].encode()[node.end_col_offset or 0 :].decode()
    return " ".join([*above, beside.partition("#")[2].strip()]).strip()


def api() -> Iterator[str]:
    """Modules of the names that notebooks and plug-ins import."""
    yield "# Python API\n"
    yield "Notebooks and plug-ins import these names from `zenpark`: [Python](../python.md) has an example of each.\n"
    yield "## Notebooks\n"
    yield from (f"::: {module}\n" for module in NOTEBOOKS)
    yield "## Plug-ins\n"
    yield "How to write one: [Plug-ins](../plugins.md).\n"
    for module in PLUGINS:
        yield f"::: {module}\n"
        yield from _structs(import_module(module), 3, parameters=False)
        yield ""


PAGES: Final[dict[str, Callable[[], Iterator[str]]]] = {
    "experiment-file": experiment_file,
    "commands": commands,
    "metrics": metrics,
    "recordings": recordings,
    "network": network,
    "api": api,
}

if __name__ == "__main__":
    print("\n".join(line for name in sys.argv[1:] or PAGES for line in PAGES[name]()))
