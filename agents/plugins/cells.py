"""Plug-ins of a notebook's cell or of a script: their source, with all that it uses, as a module of its own."""

from __future__ import annotations

import ast
import builtins
import linecache
import sys
from collections.abc import Iterator
from pathlib import Path
from symtable import SymbolTable, symtable
from types import FunctionType, ModuleType
from typing import Any, Final

from agents.plugins.registry import PluginError

PLAIN: Final = (bool, int, float, str, type(None))


def law_file(plugin: type, folder: str | Path = ".") -> str:
    """Writes a class of a notebook's cell, with all that it uses, as a module into a folder.

    Returns:
        Text that names it in an experiment file of that folder: `"spring.py:Spring"`.

    Raises:
        PluginError: If its source is not known, or it uses values of the notebook that cannot be written.
    """
    name = plugin.__name__
    file = Path(folder) / f"{name.lower()}.py"
    file.write_text(module_text(plugin), "utf-8")
    return f"{file.name}:{name}"


def module_text(plugin: type) -> str:
    """Text of a module with a class of a notebook or script, and with the imports, functions and numbers that it uses.

    Raises PluginError as `law_file`.
    """
    space, parts = dict[str, Any](), dict[str, str]()
    for function in _functions(plugin):
        space = function.__globals__

    def take(name: str, value: object) -> None:
        if name in parts or (not isinstance(value, ModuleType) and vars(builtins).get(name) is value):
            return
        parts[name] = ""  # one that uses itself ends here
        text = _imported(name, value, plugin.__module__) or _constant(name, value)
        if not text:
            text = _source(name, value)
            for used in _globals(symtable(text, name, "exec")):
                if used in space:
                    take(used, space[used])
        parts[name] = parts.pop(name) or text  # the last one so far: all that it uses stands before it

    take(plugin.__name__, plugin)
    return "\n\n".join(parts.values()) + "\n"


def _globals(table: SymbolTable) -> Iterator[str]:
    """Names outside of a text that it reads."""
    top = table.get_type() == "module"
    for symbol in table.get_symbols():
        if symbol.is_referenced() and (symbol.is_global() or (top and not symbol.is_assigned())):
            yield symbol.get_name()
    for inner in table.get_children():
        yield from _globals(inner)


def _imported(name: str, value: object, notebook: str) -> str:
    """Import of a module, or of what another module than the notebook's has; empty if it is neither."""
    if isinstance(value, ModuleType):
        return f"import {value.__name__} as {name}"
    if name in dir(face := sys.modules.get("zenpark")) and getattr(face, name) is value:
        return f"from zenpark import {name}"
    home, called = getattr(value, "__module__", None), getattr(value, "__name__", None)
    if not isinstance(home, str) or not isinstance(called, str) or home == notebook:
        return ""
    return f"from {home} import {called} as {name}" if getattr(sys.modules.get(home), called, None) is value else ""


def _constant(name: str, value: object) -> str:
    """Assignment of a number, a text or a tuple of them; empty if it is none."""
    values = value if isinstance(value, tuple) else (value,)
    if not all(isinstance(each, PLAIN) for each in values):
        return ""
    written = [f'float("{each}")' if isinstance(each, float) else repr(each) for each in values]
    return f"{name} = ({', '.join(written)},)" if isinstance(value, tuple) else f"{name} = {written[0]}"


def _functions(value: object) -> list[FunctionType]:
    """A function alone, or the methods of a class."""
    inside = vars(value).values() if isinstance(value, type) else (value,)
    return [each for each in inside if isinstance(each, FunctionType)]


def _source(name: str, value: object) -> str:
    """Source of a class with a method, or of a function; `inspect` finds none for a class of a notebook."""
    for function in _functions(value):
        lines = linecache.getlines(function.__code__.co_filename)
        for node in ast.walk(ast.parse("".join(lines))):
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == getattr(value, "__name__", ""):
                first = min([node.lineno, *(each.lineno for each in node.decorator_list)])
                if node.col_offset == 0 and first <= function.__code__.co_firstlineno <= (node.end_lineno or 0):
                    return "".join(lines[first - 1 : node.end_lineno])
    raise PluginError(
        f"{name}, a {type(value).__name__}, cannot be written into a file; make it a parameter of the class, or name "
        "the class by its file (docs/plugins.md)"
    )
