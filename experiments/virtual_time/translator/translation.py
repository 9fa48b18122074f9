"""Quiet functions as C: one C function for each Python function and the types of its arguments.

A record becomes a struct, a tuple a struct by value, a list an address with a count, `self.held` is `self->held`; C has
Python's arithmetic from `arithmetic.c`. The order is Python's: calls and indices become statements, since C may take
operands in any order. A method that its class names in `RARE` is called back in Python. What the walk has no method for
is outside of the subset, and the error names file and line.
"""

# ruff: noqa: N802 - named by the visitor
from __future__ import annotations

import ast
import linecache
import re
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from functools import cache, partial
from itertools import count
from pathlib import Path
from types import FunctionType
from typing import Any, Final, NamedTuple

from experiments.virtual_time.records import Items, RecordLayout
from experiments.virtual_time.translator.calls import NEW_SUMS, Calls
from experiments.virtual_time.translator.expressions import calls
from experiments.virtual_time.translator.kinds import (
    BOOLEAN,
    DOUBLE,
    NONE,
    STORED,
    VOID,
    WHOLE,
    Made,
    OutsideError,
    Several,
    TextType,
    Value,
    constant,
    has_value,
    item_of,
    listed,
    mangled,
    place,
    type_of,
)

ARITHMETIC: Final = Path(__file__).with_name("arithmetic.c")
TURNS: Final = 10**9  # turns of all loops of a stretch: some seconds


@cache
def definition(function: FunctionType) -> ast.FunctionDef:
    """A function in its source; raises OutsideError for a decorated one, or one within another function."""
    code = function.__code__
    last = max(end for _, end, _, _ in code.co_positions() if end)  # `inspect.getsource` takes a millisecond
    lines = linecache.getlines(code.co_filename)[code.co_firstlineno - 1 : last]
    try:
        tree = ast.parse(textwrap.dedent("".join(lines))).body[0]
    except (SyntaxError, IndexError):
        tree = ast.Pass()
    around = set(code.co_freevars) - {"__class__"}  # names around it, without that of `super`
    decorated = [ast.unparse(each) for each in getattr(tree, "decorator_list", ())] not in ([], ["property"])
    if not isinstance(tree, ast.FunctionDef) or around or decorated or hasattr(function, "__wrapped__"):
        raise OutsideError(f"{place(function)}: {function.__qualname__} is no plain function")
    return tree


class Iteration(NamedTuple):
    """Loop in C."""

    head: str
    item: Value
    most: str  # largest number of turns


class Program:
    """Functions in C, as they are asked for."""

    def __init__(self, names: Mapping[str, int] | None = None) -> None:
        """Take numbers of robots by their `names`."""
        self.names = names or {}
        self.called_back: dict[str, str] = {}  # rare functions that stay in Python, with the reasons
        self.measures: list[str] = []  # names of the measures of all laws
        self.entries: list[str] = []  # names of the functions that Python calls: fly, fly1, ...
        self._numbers = count()
        self._found: dict[tuple[Any, int, str], tuple[Callable[[], Any], Any]] = {}  # see `look`; each with a way to it
        self._names: dict[Any, str] = {}  # names of types
        self._functions: dict[Any, tuple[str, Any] | None] = {}  # names and types of results; None: under way
        self._texts = list[str]()  # types and functions, each behind those that it needs

    @property
    def functions(self) -> set[FunctionType]:
        """All that were asked for."""
        return {function for function, _ in self._functions}

    def c(self, kind: Any) -> str:
        """C's name of a type."""
        if isinstance(kind, str):
            return kind
        if isinstance(kind, TextType):
            return f"text {kind.value}"  # part of names of functions alone
        key = id(kind) if isinstance(kind, RecordLayout) else kind  # layouts are kept for ever
        if key not in self._names:
            if isinstance(kind, RecordLayout):
                name = kind.owner.__name__
                fields = {mangled(each): self._stored(of) for each, of in kind.fields.items()}
            elif isinstance(kind, Several):
                name = kind.owner.__name__
                fields = {f"_{k}": self.c(each) for k, each in enumerate(kind.parts) if has_value(each)}
            else:
                item = self.c(kind.item) if isinstance(kind, Made) else self._stored(kind.item)
                name, fields = "list", {"*at": item, "count": WHOLE}
            name = f"{mangled(name)}{len(self._names)}"
            inside = " ".join(f"{of} {field};" for field, of in (fields or {"nothing": WHOLE}).items())
            self._texts.append(f"typedef struct {{ {inside} }} {name};")
            self._names[key] = f"{name} *" if isinstance(kind, RecordLayout) else name
        return self._names[key]

    def _stored(self, kind: Any) -> str:
        return STORED[kind] if isinstance(kind, str) else self.c(type_of(kind))

    def look(self, get: Callable[..., Any], place: Any, name: str, default: Any = ...) -> Any:
        """Present meaning of a name, which is what `get` finds in a place; `changed` looks again."""
        if (key := (get, id(place), name)) not in self._found:
            way = partial(get, place, name, default)
            self._found[key] = way, way()
        return self._found[key][1]

    def changed(self) -> bool:
        """Whether a function or a constant has become another one since the walk."""
        return any(way() is not value for way, value in self._found.values())

    def function(self, function: FunctionType, types: Sequence[Any]) -> tuple[str, Any]:
        """C's name of a function for arguments of these types, and the type of its result."""
        key = (function, tuple(map(self.c, types)))
        if key not in self._functions:
            self._functions[key] = None
            name = f"{mangled(function.__qualname__.replace('.', '_'))}_{next(self._numbers)}"
            try:
                walk = Walk(self, definition(function), function.__globals__, function)
                self._functions[key] = name, walk.result_for(types)
                self._texts.append(f"\n/* {place(function)} */\n{walk.text(name)}")
            except OutsideError:
                del self._functions[key]
                raise
        found = self._functions[key]
        if found is None:
            raise OutsideError(f"{place(function)}: {function.__qualname__} calls itself")
        return found

    @property
    def is_plain(self) -> bool:
        """Whether it is the same for any law: nothing is called back, and there are no measures."""
        return not (self.called_back or self.measures)

    def copy(self) -> Program:
        """The same program, for other entries."""
        found = copy(self)
        for name in ("entries", "called_back", "measures", "_found", "_names", "_functions", "_texts"):
            setattr(found, name, copy(getattr(self, name)))
        return found

    def entry(self, source: str, space: dict[str, Any], types: Sequence[Any]) -> str:
        """Text of the program with another function, which Python calls, from the source of `stretch`.

        The function has the last name of `entries`, and returns −1 after an error.
        """
        walk = Walk(self, next(each for each in ast.parse(source).body if isinstance(each, ast.FunctionDef)), space)
        assert walk.result_for(types) == WHOLE
        name = f"fly{len(self.entries) or ''}"
        self.entries.append(name)
        given, call = walk.head(), f"stretch_{name}({', '.join(map(mangled, walk.arguments))})"
        fly = (
            f"whole {name}({given}, whole python) {{\n  back = (whole (*)(whole, whole, double *))python;\n"
            f"  turns = 0;\n  return _setjmp(way) ? -1 : {call};\n}}\n"
        )
        self._texts += [walk.text(f"stretch_{name}"), fly]
        return "\n".join([ARITHMETIC.read_text(encoding="utf-8"), *self._texts])


class Walk(Calls):
    """Statements of a function in C."""

    def result_for(self, types: Sequence[Any]) -> Any:
        """Walk through the function for arguments of these types; returns the type of its result."""
        given, tree = self._tree.args, self._tree
        if given.kwarg or (given.vararg and given.kwonlyargs):
            raise self.error(tree, "**kwargs")
        names = [each.arg for each in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
        if given.vararg:
            names, more = [*names, given.vararg.arg], len(names)
            types = [*types[:more], Several(tuple(types[more:]))]
        self.arguments = dict(zip(names, types, strict=True))
        self._locals.update(self.arguments)
        self._set.update(names)
        self.block(tree.body)
        if self._result not in (None, VOID) and not self._ended:
            raise self.error(tree, "a way to its end without a return")
        return self._result or VOID

    def head(self) -> str:
        """Arguments in C."""
        given = [f"{self._program.c(kind)} {mangled(each)}" for each, kind in self.arguments.items() if has_value(kind)]
        return ", ".join(given) or VOID

    def text(self, name: str) -> str:
        own = {each: kind for each, kind in self._locals.items() if each not in self.arguments and has_value(kind)}
        lines = [f"{self._program.c(kind)} {mangled(each)};" for each, kind in own.items()]
        result = self._program.c(self._result or VOID)
        return "\n  ".join([f"static {result} {name}({self.head()}) {{", *lines, *self._lines]) + "\n}"

    def block(self, body: Sequence[ast.stmt]) -> None:
        self._ended = False
        for each in body:
            if not (self._ended or isinstance(each, ast.Pass)):
                self.visit(each)

    def end(self, line: str) -> None:
        self.emit(line)
        self._ended = True

    def visit_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):
            self.visit(node.value)

    def visit_Assert(self, node: ast.Assert) -> None:
        self.emit(f"if (!{self.condition(node.test).text}) fail();")

    def visit_Raise(self, node: ast.Raise) -> None:
        self.end("fail();")

    def visit_Break(self, node: ast.Break | ast.Continue) -> None:
        self.end(f"{ast.unparse(node)};")

    visit_Continue = visit_Break  # noqa: N815

    def visit_Return(self, node: ast.Return) -> None:
        found = constant(None) if node.value is None else self.visit(node.value)
        kind = VOID if found.type == NONE else found.type
        self._result = self._result or kind
        self.of_type(found._replace(type=kind), self._result, node)
        self.end("return;" if kind == VOID else f"return {self.one(found)};")

    def visit_Assign(self, node: ast.Assign) -> None:
        found = self.visit(node.value)
        found = self.saved(found) if len(node.targets) > 1 else found
        for target in node.targets:
            self.assign(target, found)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.assign(node.target, self.visit(node.value))

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        if calls(node.target):
            raise self.error(node, "a call in the target of an assignment")
        before = ast.parse(ast.unparse(node.target), mode="eval").body
        for each in ast.walk(before):
            ast.copy_location(each, node)
        self.assign(node.target, self.visit(ast.copy_location(ast.BinOp(before, node.op, node.value), node)))

    def visit_If(self, node: ast.If) -> None:
        test = self.condition(node.test)
        if test.constant is not ...:
            return self.block(node.body if test.constant else node.orelse)
        self.emit(f"if ({test.text}) {{")
        before = set(self._set)
        self.block(node.body)
        after, ended = self._set, self._ended
        self._set = before
        if node.orelse:
            self.emit("} else {")
        self.block(node.orelse)
        self.emit("}")
        if not ended:  # what both branches set
            self._set = after if self._ended else after & self._set
        self._ended = ended and self._ended
        return None

    def visit_While(self, node: ast.While) -> None:
        def begin() -> None:
            test = self.condition(node.test)
            if test.constant is ... or not test.constant:
                self.emit(f"if (!{test.text}) break;")

        self.loop("for (;;) {", node, begin)
        never_over = isinstance(node.test, ast.Constant) and node.test.value
        self._ended = bool(never_over) and not any(isinstance(each, ast.Break) for each in ast.walk(node))

    def visit_For(self, node: ast.For) -> None:
        found = self.iteration(node.iter, node)
        if isinstance(found, Iteration):
            return self.loop(found.head, node, lambda: self.assign(node.target, found.item))
        if any(isinstance(each, ast.Break | ast.Continue) for each in ast.walk(node)):
            raise self.error(node, "break or continue in a loop over such a tuple")
        for value in found:
            self.bind(node.target, value)
            self.block(node.body)
            if self._ended:
                raise self.error(node, "a return in a loop over such a tuple")
        return None

    def iteration(self, node: ast.expr, loop: ast.AST) -> Iteration | Sequence[Value]:
        """A loop over a range, a list, `zip` or `enumerate`; parts of a tuple that is no list of numbers."""
        k, function = self.new(), ast.unparse(node.func) if isinstance(node, ast.Call) else ""
        if isinstance(node, ast.Call) and function == "range":
            given = [self.saved(self.of_type(each, WHOLE, node)) for each in self.several(node.args)]
            first, end, step = ([constant(0), given[0], constant(1)] if len(given) == 1 else [*given, constant(1)])[:3]
            if node.keywords or not step.constant or step.constant is ...:
                raise self.error(loop, "a range with a step that is no constant")
            order, most = "<" if step.constant > 0 else ">", f"py_turns({first.text}, {end.text}, {step.text})"
            head = f"for (whole {k} = {first.text}; {k} {order} {end.text}; {k} += {step.text}) {{"
            return Iteration(head, Value(WHOLE, k), most)
        together = isinstance(node, ast.Call) and function in ("zip", "enumerate")
        values = self.several(node.args) if together and isinstance(node, ast.Call) else [self.visit(node)]
        if not together and isinstance(values[0].type, Several):
            if isinstance(values[0].constant, Mapping):
                return [constant(each) for each in values[0].constant]
            parts = self.parts(values[0], node)
            if not parts or parts[0].type not in (DOUBLE, WHOLE):
                return parts
        lists = [self.saved(self.as_list(each, node)) for each in values]
        if not all(isinstance(each.type, Items | Made) for each in lists):
            raise self.error(node, "a loop over something else than a range, a list or a tuple")
        items = [Value(item_of(each.type), f"{each.text}.at[{k}]") for each in lists]
        most = f"{lists[0].text}.count"
        for other in lists[1:]:  # strict, whatever `zip` says
            self.emit(f"if ({other.text}.count != {most}) fail();")
        items = [Value(WHOLE, k), *items] if function == "enumerate" else items
        item = items[0]
        if together:
            item = Value(Several(tuple(each.type for each in items)), "", ..., items)
        return Iteration(f"for (whole {k} = 0; {k} < {most}; {k}++) {{", item, most)

    def bind(self, target: ast.expr, value: Value) -> None:
        """Let a variable of a loop stand for a value, of a text too."""
        if isinstance(target, ast.Name) and isinstance(value.type, TextType):
            self._locals[target.id] = value.type
            self._set.add(target.id)
        else:
            self.assign(target, value)

    def items(
        self, node: ast.expr, use: Callable[[Value], None], begin: Callable[[str], None] = lambda _: None
    ) -> None:
        """Use each item of a comprehension, a list or a tuple, in a loop that `use` may leave by `break`.

        Args:
            begin: Called before the loop with the largest number of items, in C.
        """
        if isinstance(node, ast.List):
            for each in node.elts:
                self.items(each.value, use) if isinstance(each, ast.Starred) else use(self.visit(each))
            return
        (generator,) = node.generators if isinstance(node, ast.GeneratorExp | ast.ListComp) else [None]
        found = self.iteration(node if generator is None else generator.iter, node)
        begin(found.most if isinstance(found, Iteration) else str(len(found)))
        targets = (
            [] if generator is None else [each.id for each in ast.walk(generator.target) if isinstance(each, ast.Name)]
        )
        before, mark = (dict(self._locals), dict(self._names), set(self._set)), len(self._lines)
        for name in targets:
            self._locals.pop(name, None)
            self._names[name] = self.new()
        self.emit(found.head if isinstance(found, Iteration) else "do {")
        for value in [found.item] if isinstance(found, Iteration) else found:
            tests = [] if generator is None else generator.ifs
            if generator is not None:
                self.bind(generator.target, value)
            for test in tests:
                self.emit(f"if ({self.condition(test).text}) {{")
            use(value if generator is None else self.visit(node.elt))  # type: ignore[attr-defined]
            self.emit("}" * len(tests))
        self.emit("}" if isinstance(found, Iteration) else "} while (0);")
        own = [(self._locals[name], self._names[name]) for name in targets if has_value(self._locals.get(name, NONE))]
        self._lines[mark:mark] = [f"{self._program.c(kind)} {name};" for kind, name in own]
        locals_before, self._names, self._set = before
        for name in targets:
            self._locals.pop(name, None)
            if name in locals_before:
                self._locals[name] = locals_before[name]

    def visit_ListComp(self, node: ast.ListComp) -> Value:
        """A list in the memory of this step."""
        name, kinds = self.new(), list[Any]()
        marks = list[tuple[int, str]]()

        def use(value: Value) -> None:
            kinds.append(value.type)
            self.emit(f"{name}.at[{name}.count++] = {self.one(self.of_type(value, kinds[0], node))};")

        self.items(node, use, lambda most: marks.append((len(self._lines), most)))
        (mark, most), made = marks[0], Made(kinds[0])
        self._lines.insert(mark, f"{self._program.c(made)} {name} = {{py_room(({most}) * sizeof(*{name}.at)), 0}};")
        return Value(made, name)

    def visit_DictComp(self, node: ast.DictComp) -> Value:
        """A dictionary with the names of a table of constants."""
        (generator,) = node.generators if len(node.generators) == 1 else [None]
        if generator is None or generator.ifs or not isinstance(generator.target, ast.Name):
            raise self.error(node, "a dictionary with a condition")
        names = self.iteration(generator.iter, node)
        if isinstance(names, Iteration) or ast.unparse(node.key) != generator.target.id:
            raise self.error(node, "a dictionary by something else than names")
        before, values = (dict(self._locals), set(self._set)), dict[str, Value]()
        for name in names:
            self.bind(generator.target, name)
            values[name.constant] = self.saved(self.visit(node.value))
        self._locals, self._set = before
        return self.with_names(dict, {name: values[name] for name in sorted(values)})

    def builtin(self, found: Any, node: ast.Call) -> Value:
        """Also `any`, `all`, `sum`, `min` and `max` of a generator or a list."""
        name, given = getattr(found, "__name__", ""), node.args
        of_items = len(given) == 1 and found in (any, all, sum, min, max)
        if not of_items or (
            found in (min, max) and not isinstance(given[0], ast.GeneratorExp | ast.ListComp | ast.List)
        ):
            return super().builtin(found, node)
        result, some = self.new(), self.new()
        kinds = list[Any]()

        def use(value: Value) -> None:
            if found in (any, all):
                test = f"{'!' * (found is all)}{self.truth(value, node).text}"
                self.emit(f"if ({test}) {{ {result} = {int(found is any)}; break; }}")
                return
            kinds.append(value.type)
            value = self.of_type(value, kinds[0], node)
            if value.type not in (DOUBLE, WHOLE) or (
                found is sum and (value.type == WHOLE or sys.version_info >= NEW_SUMS)
            ):
                raise self.error(node, f"{name} of {listed(value.type)}")
            if found is sum:
                self.emit(f"{result} += {value.text};")
            else:
                better = f"py_{name}{'_i' * (value.type == WHOLE)}({result}, {value.text})"
                self.emit(f"{result} = {some} ? {better} : {value.text};", f"{some} = 1;")

        mark = len(self._lines)
        self.items(given[0], use)
        kind = BOOLEAN if found in (any, all) else kinds[0] if kinds else DOUBLE
        self._lines[mark:mark] = [f"{kind} {result} = {int(found is all)}, {some} = 0;"]
        if found in (min, max):
            default = [self.visit(each.value) for each in node.keywords if each.arg == "default"]
            other = f"{result} = {self.of_type(default[0], kind, node).text};" if default else "fail();"
            self.emit(f"if (!{some}) {other}")
        return Value(kind, result)

    def loop(self, head: str, node: ast.For | ast.While, begin: Callable[[], None]) -> None:
        if node.orelse:
            raise self.error(node.orelse[0], "`else` of a loop")
        self.emit(head, f"if (++turns > {TURNS}) fail();")
        before = set(self._set)
        begin()
        self.block(node.body)
        self.emit("}")
        self._set, self._ended = before, False

    def assign(self, target: ast.expr, value: Value) -> None:
        if isinstance(target, ast.Tuple | ast.List):
            pairs = list(self.leaves(target, value))
            if _overlap([ast.unparse(each) for each, _ in pairs], [self.one(each) for _, each in pairs]):
                pairs = [(each, self.saved(part)) for each, part in pairs]
            for each, part in pairs:
                self.assign(each, part)
            return
        value = self.saved(value) if isinstance(target, ast.Subscript) or calls(target) else value
        if isinstance(target, ast.Name):
            kind = self._locals.setdefault(target.id, value.type)
            into = self._names.get(target.id) or mangled(target.id)
            self._set.add(target.id)
            if kind == value.type and not has_value(kind):
                return
        elif isinstance(target, ast.Attribute):
            thing = self.visit(target.value)
            if value.type == Several((), (), dict) and target.attr in getattr(thing.type, "fixed", ()):
                return
            if not (isinstance(thing.type, RecordLayout) and target.attr in thing.type.fields):
                raise self.error(target, f"an attribute {target.attr} that is none or is not there")
            kind, into = type_of(thing.type.fields[target.attr]), f"{thing.text}->{mangled(target.attr)}"
        elif isinstance(target, ast.Subscript):
            items, k = self.several([target.value, target.slice])
            kind, into, *_ = self.item(items, k, target)
        else:
            self.generic_visit(target)
        self.emit(f"{into} = {self.one(self.of_type(value, kind, target))};")

    def leaves(self, target: ast.expr, value: Value) -> Iterator[tuple[ast.expr, Value]]:
        """Targets that are no tuples, each with its value."""
        if not isinstance(target, ast.Tuple | ast.List):
            yield target, value
            return
        parts = self.parts(value, target)
        if len(parts) != len(target.elts):
            raise self.error(target, "a tuple of another length")
        for each, part in zip(target.elts, parts, strict=True):
            yield from self.leaves(each, part)


def _overlap(targets: Sequence[str], texts: Sequence[str]) -> bool:
    """Whether setting one of several targets may change a value that is still to be read."""
    read, memory = set(re.findall(r"\w+", " ".join(texts))), any("->" in each or "[" in each for each in texts)
    return len(targets) > 1 and any(mangled(each) in read or (memory and not each.isidentifier()) for each in targets)
