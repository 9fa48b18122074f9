"""Quiet functions as C: one C function for each Python function and the types of its arguments.

A record becomes a struct, a tuple a struct by value, a list an address with a count, `self.held` is `self->held`; C has
Python's arithmetic from `arithmetic.c`. The order is Python's: calls and indices become statements, since C may take
operands in any order. A method that its class names in `RARE` is called back in Python. What the walk has no method for
is outside of the subset, and the error names file and line.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import linecache
import math
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, Final, NamedTuple

from experiments.virtual_time.records import BOOL, FLOAT, INT, Floats, Items, RecordLayout

ARITHMETIC: Final = Path(__file__).with_name("arithmetic.c")
TURNS: Final = 10**9  # turns of all loops of a stretch: some seconds
LEAVE: Final = "@leave"  # stands for the return of a function at an error
# types: numbers, by C's names, and what has no value; that of an object is its layout, that of a list its `Items`
DOUBLE, WHOLE, BOOLEAN, VOID, NONE = "double", "whole", "_Bool", "void", "none"
STORED: Final = {FLOAT: DOUBLE, INT: WHOLE, BOOL: WHOLE}  # types in a record
WORDS: Final = {DOUBLE: "a float", WHOLE: "a whole number", BOOLEAN: "a bool", VOID: "nothing", NONE: "None"}
COMPARISONS: Final = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=", ast.Is: "==",
    ast.IsNot: "!=",
}  # fmt: skip
BITS: Final = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}
SUMS: Final = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*"}
DIVISIONS: Final = {  # function of `arithmetic.c` by operator and type
    (ast.Div, DOUBLE): "py_over", (ast.Mod, DOUBLE): "py_rest", (ast.Mod, WHOLE): "py_rest_i",
    (ast.FloorDiv, DOUBLE): "py_floor_over", (ast.FloorDiv, WHOLE): "py_floor_i", (ast.Pow, DOUBLE): "py_power",
    (ast.LShift, WHOLE): "py_left", (ast.RShift, WHOLE): "py_right",
}  # fmt: skip
OF_FLOATS: Final = "sqrt sin cos tan asin acos atan atan2 log exp expm1 tanh fabs copysign degrees radians"
MATH: Final = {  # functions of `math`, with the types of their values
    **dict.fromkeys(OF_FLOATS.split(), DOUBLE), **dict.fromkeys(("floor", "ceil", "trunc"), WHOLE),
    **dict.fromkeys(("isfinite", "isinf", "isnan"), BOOLEAN),
}  # fmt: skip
BUILTINS: Final = {"abs", "bool", "float", "int", "len", "max", "min", "round"}
SMALL: Final = 1 << 31  # a sum with a constant below this needs no check
LARGEST: Final = 1 << 61  # whole number of which C knows sums
NAMED: Final[dict[type, str]] = {  # constructs outside of the subset
    ast.JoinedStr: "an f-string", ast.Dict: "a dictionary", ast.Set: "a set", ast.List: "a list", ast.Try: "try",
    ast.ListComp: "a comprehension", ast.SetComp: "a comprehension", ast.DictComp: "a comprehension", ast.With: "with",
    ast.GeneratorExp: "a generator", ast.Lambda: "a lambda", ast.Starred: "*args", ast.Delete: "del",
    ast.FunctionDef: "a function within it", ast.Slice: "a slice",
}  # fmt: skip
C_WORDS: Final = re.compile(
    "auto|break|case|char|const|continue|default|do|double|else|enum|extern|float|for|goto|if|inline|int|long|register|"
    "restrict|return|short|signed|sizeof|static|struct|switch|typedef|union|unsigned|void|volatile|while|"
    "whole|fault|turns|back|unknown|inf|exact|largest|nothing|fly|stretch|_.*|.*_|py_.*"
)


class OutsideError(Exception):
    """Something outside of the subset, with its place."""


class Several(NamedTuple):
    """Type of a tuple."""

    parts: tuple[Any, ...]


class Value(NamedTuple):
    """C expression with its type; of a constant its value, else ..., of a tuple that is put together its parts."""

    type: Any
    text: str
    constant: Any = ...
    parts: Sequence[Value] | None = None


def type_of(kind: Any) -> Any:
    """Type of a value of a record."""
    if isinstance(kind, Floats):
        return Several((DOUBLE,) * kind.size)
    return BOOLEAN if kind == BOOL else STORED[kind] if isinstance(kind, str) else kind


def listed(kind: Any) -> str:
    """A type in words."""
    if isinstance(kind, Several | Items):
        return f"a tuple of {len(kind.parts)}" if isinstance(kind, Several) else "a list"
    return f"an object of {kind.owner.__name__}" if isinstance(kind, RecordLayout) else WORDS[kind]


def constant(x: Any) -> Value:
    """A constant; raises TypeError for one that C does not have."""
    if x is None:
        return Value(NONE, "0", None)
    if isinstance(x, int) and abs(x) < LARGEST:  # also a member of an enumeration
        return Value(BOOLEAN, str(int(x)), x) if isinstance(x, bool) else Value(WHOLE, f"({int(x)}LL)", int(x))
    if type(x) is float:
        text = x.hex() if math.isfinite(x) else "unknown.number" if math.isnan(x) else "inf" if x > 0.0 else "-inf"
        return Value(DOUBLE, f"({text})", x)
    if not isinstance(x, tuple | list):
        raise TypeError("a text" if isinstance(x, str) else f"a {type(x).__name__}, which is no number")
    parts = [constant(each) for each in x]
    return Value(Several(tuple(each.type for each in parts)), "", tuple(x), parts)


@cache
def mangled(name: str) -> str:
    """A name of Python that is free in C."""
    name = "".join(each if each.isascii() else f"u{ord(each):x}" for each in name)
    return f"{name}_" if C_WORDS.fullmatch(name) else name


def place(function: Callable[..., Any], line: int = 1) -> str:
    """File and line of a function, at line `line` of its source."""
    code = inspect.unwrap(function).__code__
    return f"{code.co_filename}:{code.co_firstlineno + line - 1}"


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


class Program:
    """Functions in C, as they are asked for."""

    def __init__(self) -> None:
        self._found: list[tuple[Callable[[], Any], Any]] = []  # what names stood for, each with a way to look again
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
        key = id(kind) if isinstance(kind, RecordLayout) else kind  # layouts are kept for ever
        if key not in self._names:
            if isinstance(kind, RecordLayout):
                name = kind.owner.__name__
                fields = {mangled(each): self._stored(of) for each, of in kind.fields.items()}
            elif isinstance(kind, Several):
                name, fields = "tuple", {f"_{k}": self.c(each) for k, each in enumerate(kind.parts)}
            else:
                name, fields = "list", {"*at": self._stored(kind.item), "count": WHOLE}
            name = f"{mangled(name)}{len(self._names)}"
            inside = " ".join(f"{of} {field};" for field, of in (fields or {"nothing": WHOLE}).items())
            self._texts.append(f"typedef struct {{ {inside} }} {name};")
            self._names[key] = f"{name} *" if isinstance(kind, RecordLayout) else name
        return self._names[key]

    def _stored(self, kind: Any) -> str:
        return STORED[kind] if isinstance(kind, str) else self.c(type_of(kind))

    def look(self, way: Callable[[], Any]) -> Any:
        """Present meaning of a name; `changed` looks again."""
        self._found.append((way, found := way()))
        return found

    def changed(self) -> bool:
        """Whether a function or a constant has become another one since the walk."""
        return any(way() is not value for way, value in self._found)

    def function(self, function: FunctionType, types: Sequence[Any]) -> tuple[str, Any]:
        """C's name of a function for arguments of these types, and the type of its result."""
        key = (function, tuple(map(self.c, types)))
        if key not in self._functions:
            self._functions[key] = None
            walk = Walk(self, definition(function), function.__globals__, function)
            name = f"{mangled(function.__qualname__.replace('.', '_'))}_{len(self._functions)}"
            self._functions[key] = name, walk.result_for(types)
            self._texts.append(f"\n/* {place(function)} */\n{walk.text(name)}")
        found = self._functions[key]
        if found is None:
            raise OutsideError(f"{place(function)}: {function.__qualname__} calls itself")
        return found

    def entry(self, source: str, space: dict[str, Any], types: Sequence[Any]) -> str:
        """Text of a function `fly`, which Python calls, from the source of `stretch`, and of all that this calls.

        It returns −1 after an error.
        """
        walk = Walk(self, next(each for each in ast.parse(source).body if isinstance(each, ast.FunctionDef)), space)
        assert walk.result_for(types) == WHOLE
        given, call = walk.head(), f"stretch({', '.join(map(mangled, walk.arguments))})"
        fly = (
            f"whole fly({given}, whole python) {{\n  back = (whole (*)(whole, whole, double *))python;\n"
            f"  fault = turns = 0;\n  whole last = {call};\n  return fault ? -1 : last;\n}}\n"
        )
        return "\n".join([ARITHMETIC.read_text(encoding="utf-8"), *self._texts, walk.text("stretch"), fly])


class Walk(ast.NodeVisitor):
    """Statements of a function in C; a visit of an expression gives its `Value`."""

    def __init__(
        self, program: Program, tree: ast.FunctionDef, space: dict[str, Any], function: FunctionType | None = None
    ) -> None:
        self._program, self._tree, self._space, self._function = program, tree, space, function
        self._lines = list[str]()
        self._count, self._ended = 0, False
        self._locals, self._set = dict[str, Any](), set[str]()  # types, and names that have a value here in any case
        self._result: Any = None  # type
        self.arguments: dict[str, Any] = {}

    def result_for(self, types: Sequence[Any]) -> Any:
        """Walk through the function for arguments of these types; returns the type of its result."""
        given, tree = self._tree.args, self._tree
        if given.vararg or given.kwarg:
            raise self.error(tree, "*args")
        names = [each.arg for each in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
        self.arguments = dict(zip(names, types, strict=True))
        self._locals.update(self.arguments)
        self._set.update(names)
        self.block(tree.body)
        if self._result not in (None, VOID) and not self._ended:
            raise self.error(tree, "a way to its end without a return")
        return self._result or VOID

    def head(self) -> str:
        """Arguments in C."""
        given = [f"{self._program.c(kind)} {mangled(each)}" for each, kind in self.arguments.items() if kind != NONE]
        return ", ".join(given) or VOID

    def text(self, name: str) -> str:
        own = {each: kind for each, kind in self._locals.items() if each not in self.arguments and kind != NONE}
        lines = [f"{self._program.c(kind)} {mangled(each)};" for each, kind in own.items()]
        result = self._program.c(self._result or VOID)
        if result != VOID:
            lines.append(f"static const {result} nothing;")
        lines += [line.replace(LEAVE, "return;" if result == VOID else "return nothing;") for line in self._lines]
        return "\n  ".join([f"static {result} {name}({self.head()}) {{", *lines]) + "\n}"

    def error(self, node: ast.AST, what: str) -> OutsideError:
        if self._function is None:
            return OutsideError(f"{what}: {ast.unparse(node)}")
        where = place(self._function, getattr(node, "lineno", 1))
        return OutsideError(f"{where}: {self._function.__qualname__} uses {what}")

    def generic_visit(self, node: ast.AST) -> Any:
        raise self.error(node, NAMED.get(type(node), f"`{ast.unparse(node)[:40]}`"))

    def emit(self, *lines: str) -> None:
        self._lines += lines

    # ------------------------------------------------------------------ statements

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
        self.emit(f"if (!{self.condition(node.test).text}) {{ fault = 1; {LEAVE} }}")

    def visit_Raise(self, node: ast.Raise) -> None:
        self.end(f"fault = 1; {LEAVE}")

    def visit_Break(self, node: ast.Break | ast.Continue) -> None:
        self.end(f"{ast.unparse(node)};")

    visit_Continue = visit_Break  # noqa: N815 - named by the visitor

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
        if _calls(node.target):
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
        if isinstance(node.iter, ast.Call) and ast.unparse(node.iter.func) == "range":
            given = [self.saved(self.of_type(each, WHOLE, node)) for each in self.several(node.iter.args)]
            first, end, step = ([constant(0), given[0], constant(1)] if len(given) == 1 else [*given, constant(1)])[:3]
            if node.iter.keywords or not step.constant or step.constant is ...:
                raise self.error(node, "a range with a step that is no constant")
            k, order = self.new(), "<" if step.constant > 0 else ">"
            head = f"for (whole {k} = {first.text}; {k} {order} {end.text}; {k} += {step.text}) {{"
            return self.loop(head, node, lambda: self.assign(node.target, Value(WHOLE, k)))
        items = self.visit(node.iter)
        if isinstance(items.type, Several) and not items.type.parts:
            return None
        items = self.as_list(items, node)
        if not isinstance(items.type, Items):
            raise self.error(node.iter, "a loop over something else than a range, a list or a tuple")
        items, k = self.saved(items), self.new()
        value = Value(type_of(items.type.item), f"{items.text}.at[{k}]")
        head = f"for (whole {k} = 0; {k} < {items.text}.count; {k}++) {{"
        return self.loop(head, node, lambda: self.assign(node.target, value))

    def loop(self, head: str, node: ast.For | ast.While, begin: Callable[[], None]) -> None:
        if node.orelse:
            raise self.error(node.orelse[0], "`else` of a loop")
        self.emit(head, f"if (fault || ++turns > {TURNS}) {{ fault = 1; {LEAVE} }}")
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
        value = self.saved(value) if isinstance(target, ast.Subscript) or _calls(target) else value
        if isinstance(target, ast.Name):
            kind, into = self._locals.setdefault(target.id, value.type), mangled(target.id)
            self._set.add(target.id)
            if kind == value.type == NONE:
                return
        elif isinstance(target, ast.Attribute):
            thing = self.visit(target.value)
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

    # ------------------------------------------------------------------ values

    def new(self) -> str:
        self._count += 1
        return f"_{self._count}"

    def saved(self, value: Value) -> Value:
        """The value as it is now, whatever follows."""
        if value.parts is not None:
            return value._replace(parts=[self.saved(each) for each in value.parts])
        if value.constant is not ... or value.type == NONE:
            return value
        name = self.new()
        self.emit(f"{self._program.c(value.type)} {name} = {value.text};")
        return Value(value.type, name)

    def aside(self, visit: Callable[[], Value]) -> tuple[Value, list[str]]:
        """A value, and the statements before it, which are not made yet."""
        mark = len(self._lines)
        value = visit()
        later = self._lines[mark:]
        del self._lines[mark:]
        return value, later

    def several(self, nodes: Sequence[ast.expr]) -> list[Value]:
        """Values in their order: what stands before a call is read before it."""
        found = list[Value]()
        for node in nodes:
            value, later = self.aside(partial(self.visit, node))
            if later:
                found = [self.saved(each) for each in found]
            self.emit(*later)
            found.append(value)
        return found

    def one(self, value: Value) -> str:
        """Text of a value, of a tuple too."""
        if value.parts is None:
            return value.text
        return f"({self._program.c(value.type)}){{" + (", ".join(map(self.one, value.parts)) or "0") + "}"

    def parts(self, value: Value, node: ast.AST) -> Sequence[Value]:
        if value.parts is not None:
            return value.parts
        if not isinstance(value.type, Several):
            raise self.error(node, "parts of something that is no tuple")
        return [Value(each, f"{value.text}._{k}") for k, each in enumerate(value.type.parts)]

    def of_type(self, value: Value, kind: Any, node: ast.AST) -> Value:
        """The value; raises OutsideError if it has another type."""
        if value.type != kind:
            raise self.error(node, f"{listed(value.type)} where {listed(kind)} stands otherwise")
        return value

    def number(self, value: Value, kind: str, node: ast.AST) -> Value:
        """The value as a number of this type, as Python's arithmetic takes it."""
        if value.type == kind:
            return value
        if value.type not in (WHOLE, BOOLEAN) or kind == BOOLEAN:
            raise self.error(node, f"{listed(value.type)} where a number belongs")
        if value.constant is not ...:
            return constant(float(value.constant) if kind == DOUBLE else int(value.constant))
        return Value(kind, f"({kind})({value.text})")

    def condition(self, node: ast.expr) -> Value:
        """Whether an expression is true."""
        if isinstance(node, ast.BoolOp):
            return self.joined(node, self.condition)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            found = self.condition(node.operand)
            return Value(BOOLEAN, f"(!{found.text})") if found.constant is ... else constant(not found.constant)
        return self.truth(self.visit(node), node)

    def truth(self, value: Value, node: ast.AST) -> Value:
        if value.constant is not ...:
            return constant(bool(value.constant))
        if isinstance(value.type, Several):
            return constant(bool(value.type.parts))
        if isinstance(value.type, RecordLayout):
            if any(hasattr(value.type.owner, name) for name in ("__bool__", "__len__")):
                raise self.error(node, "the truth of an object")
            return constant(True)
        if isinstance(value.type, Items):
            return Value(BOOLEAN, f"({value.text}.count != 0)")
        return value if value.type == BOOLEAN else Value(BOOLEAN, f"({value.text} != 0)")

    def visit_Constant(self, node: ast.Constant) -> Value:
        return self.known(node.value, node)

    def visit_Tuple(self, node: ast.Tuple) -> Value:
        parts = self.several(node.elts)
        known = tuple(each.constant for each in parts) if all(each.constant is not ... for each in parts) else ...
        return Value(Several(tuple(each.type for each in parts)), "", known, parts)

    def visit_Name(self, node: ast.Name) -> Value:
        if node.id in self._locals:
            if node.id not in self._set:
                raise self.error(node, f"{node.id}, which a branch or a loop leaves unset")
            kind = self._locals[node.id]
            return constant(None) if kind == NONE else Value(kind, mangled(node.id))
        return self.known(self.named(node.id), node)

    def named(self, name: str) -> Any:
        """Meaning of a name outside of the function, ... if it has none."""
        return self._program.look(partial(self._space.get, name, getattr(builtins, name, ...)))

    def known(self, found: Any, node: ast.AST) -> Value:
        try:
            return constant(found)
        except TypeError as error:
            name = "numpy" if getattr(found, "__name__", "").partition(".")[0] == "numpy" else ast.unparse(node)
            raise self.error(node, name if isinstance(found, ModuleType) else f"{name}: {error}") from None

    def of_module(self, node: ast.expr) -> Any:
        """Object behind `module.name` or `Class.name`, ... if it is neither."""
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id not in self._locals:
            owner = self.named(node.value.id)
            if isinstance(owner, ModuleType | type):
                return self._program.look(partial(getattr, owner, node.attr, None))
        return ...

    def visit_Attribute(self, node: ast.Attribute) -> Value:
        if (found := self.of_module(node)) is not ...:
            return self.known(found, node)
        thing = self.visit(node.value)
        layout, name = thing.type, node.attr
        if not isinstance(layout, RecordLayout):
            raise self.error(node, f"an attribute of {listed(layout)}")
        if name in layout.fields:
            return Value(type_of(layout.fields[name]), f"{thing.text}->{mangled(name)}")
        if name in layout.fixed:
            return self.known(layout.fixed[name], node)
        found = self._program.look(partial(inspect.getattr_static, layout.owner, name, ...))
        if isinstance(found, property) and isinstance(found.fget, FunctionType):
            return self.call(found.fget, [thing], {}, node)
        return self.known(found, node)

    def visit_Subscript(self, node: ast.Subscript) -> Value:
        items, k = self.several([node.value, node.slice])
        if isinstance(items.type, Several) and isinstance(k.constant, int):
            parts = self.parts(items, node)
            if not -len(parts) <= k.constant < len(parts):
                raise self.error(node, "an index outside of a tuple")
            return parts[k.constant]
        return self.item(self.as_list(items, node), k, node)

    def as_list(self, value: Value, node: ast.AST) -> Value:
        """A list, or a tuple of numbers of one type as one."""
        if not isinstance(value.type, Several):
            return value
        (kind, *others), name = value.type.parts, self.new()
        if kind not in (DOUBLE, WHOLE) or any(each != kind for each in others):
            raise self.error(node, "a loop over, or an index of, a tuple of several types")
        items = Items(FLOAT if kind == DOUBLE else INT)
        self.emit(f"{kind} {name}[] = {{{', '.join(self.one(each) for each in self.parts(value, node))}}};")
        return Value(items, f"(({self._program.c(items)}){{{name}, {len(others) + 1}}})")

    def item(self, items: Value, k: Value, node: ast.AST) -> Value:
        """Item of a list; the function ends at an index that is not within it."""
        if not isinstance(items.type, Items):
            raise self.error(node, f"an index of {listed(items.type)}")
        name, count = self.new(), f"{items.text}.count"
        self.emit(f"whole {name} = {self.number(k, WHOLE, node).text};")
        if k.constant is ... or k.constant < 0:
            self.emit(f"if ({name} < 0) {name} += {count};")
        self.emit(f"if ((unsigned long long){name} >= (unsigned long long){count}) {{ fault = 1; {LEAVE} }}")
        return Value(type_of(items.type.item), f"{items.text}.at[{name}]")

    def visit_UnaryOp(self, node: ast.UnaryOp) -> Value:
        if isinstance(node.op, ast.Not):
            return self.condition(node)
        found = self.visit(node.operand)
        found = self.number(found, DOUBLE if found.type == DOUBLE else WHOLE, node)
        if isinstance(node.op, ast.USub):
            return Value(found.type, f"(-{found.text})") if found.constant is ... else constant(-found.constant)
        if isinstance(node.op, ast.UAdd):
            return found
        return Value(WHOLE, f"(~{self.of_type(found, WHOLE, node).text})")

    def visit_BinOp(self, node: ast.BinOp) -> Value:  # noqa: PLR0911 - one for each sort
        (a, b), op = self.several([node.left, node.right]), type(node.op)
        kind = WHOLE if {a.type, b.type} <= {WHOLE, BOOLEAN} else DOUBLE
        if op in BITS and kind == WHOLE:
            both = BOOLEAN if a.type == b.type == BOOLEAN else WHOLE
            return Value(both, f"({a.text} {BITS[op]} {b.text})")
        a, b = self.number(a, kind, node), self.number(b, kind, node)
        if kind == WHOLE and op is ast.Div:
            return Value(DOUBLE, f"py_over(py_exact({a.text}), py_exact({b.text}))")
        if kind == WHOLE and op is ast.Pow:  # a negative exponent makes it a float
            if b.constant is ... or not 0 <= b.constant < 64:
                raise self.error(node, "a power of a whole number with an exponent that is no small constant")
            return Value(WHOLE, f"py_product({a.text}, " * b.constant + "1LL" + ")" * b.constant)
        if op in SUMS:
            small = any(each.constant is not ... and abs(each.constant) < SMALL for each in (a, b))
            if kind == WHOLE and op is ast.Mult:
                return Value(WHOLE, f"py_product({a.text}, {b.text})")
            return Value(kind, f"{'py_fits' * (kind == WHOLE and not small)}({a.text} {SUMS[op]} {b.text})")
        if (op, kind) not in DIVISIONS:
            raise self.error(node, f"`{ast.unparse(node)[:40]}`")
        if op is ast.Div and b.constant not in (..., 0.0):
            return Value(DOUBLE, f"({a.text} / {b.text})")
        return Value(kind, f"{DIVISIONS[op, kind]}({a.text}, {b.text})")

    def visit_BoolOp(self, node: ast.BoolOp) -> Value:
        return self.joined(node, self.visit)

    def joined(self, node: ast.BoolOp, visit: Callable[[ast.expr], Value]) -> Value:
        """The value that decides, or the last one: what follows it is not computed."""
        word, decides = ("||", True) if isinstance(node.op, ast.Or) else ("&&", False)
        found, later = self.aside(partial(visit, node.values[-1]))
        for each in reversed(node.values[:-1]):
            following, after = found, later
            found, later = self.aside(partial(visit, each))
            if found.constant is not ...:
                if bool(found.constant) != decides:
                    found, later = following, [*later, *after]
                continue
            if found.type == following.type == BOOLEAN and not after:
                found = Value(BOOLEAN, f"({found.text} {word} {following.text})")
                continue
            self.of_type(following, found.type, node)
            kept = Value(found.type, self.new())
            test = self.truth(kept, node)
            if test.constant is not ...:
                raise self.error(node, f"`and` or `or` of {listed(found.type)}")
            later += [
                f"{self._program.c(found.type)} {kept.text} = {found.text};",
                f"if ({'!' * decides}{test.text}) {{",
            ]
            later += [*after, f"{kept.text} = {self.one(following)};", "}"]
            found = kept
        self.emit(*later)
        return found

    def visit_IfExp(self, node: ast.IfExp) -> Value:
        test = self.condition(node.test)
        if test.constant is not ...:
            decided: Value = self.visit(node.body if test.constant else node.orelse)
            return decided
        a, first = self.aside(partial(self.visit, node.body))
        b, second = self.aside(partial(self.visit, node.orelse))
        self.of_type(b, a.type, node)
        if not (first or second):
            return Value(a.type, f"({test.text} ? {self.one(a)} : {self.one(b)})")
        name = self.new()
        self.emit(f"{self._program.c(a.type)} {name};", f"if ({test.text}) {{", *first, f"{name} = {self.one(a)};")
        self.emit("} else {", *second, f"{name} = {self.one(b)};", "}")
        return Value(a.type, name)

    def visit_Compare(self, node: ast.Compare) -> Value:
        values = [node.left, *node.comparators]
        if len(node.ops) > 1:  # a < b < c is a < b and b < c, with b computed once
            if any(map(_calls, values[1:-1])):
                raise self.error(node, "a call within a chain of comparisons")
            each: list[ast.expr] = [
                ast.Compare(a, [op], [b]) for a, op, b in zip(values, node.ops, values[1:], strict=False)
            ]
            whole = ast.BoolOp(ast.And(), [ast.copy_location(pair, node) for pair in each])
            return self.joined(ast.copy_location(whole, node), self.visit)
        (a, b), op = self.several(values), type(node.ops[0])
        identity, word = op in (ast.Is, ast.IsNot), COMPARISONS.get(op, "")
        if NONE in (a.type, b.type) and word:
            return constant((a.type == b.type) == (word == "=="))
        same_object = identity and isinstance(a.type, RecordLayout) and a.type == b.type
        if not word or not (same_object or ({a.type, b.type} <= {DOUBLE, WHOLE, BOOLEAN} and not identity)):
            raise self.error(
                node, f"a comparison of {listed(a.type)} by `{ast.unparse(node)[:40]}`" if word else "`in`"
            )
        if {a.type, b.type} == {DOUBLE, WHOLE}:  # Python compares the exact values
            a, b = (
                Value(DOUBLE, f"py_exact({each.text})") if each.type == WHOLE and each.constant is ... else each
                for each in (a, b)
            )
        return Value(BOOLEAN, f"({a.text} {word} {b.text})")

    # ------------------------------------------------------------------ calls

    def visit_Call(self, node: ast.Call) -> Value:
        by_name, owner = isinstance(node.func, ast.Name) and node.func.id not in self._locals, list[ast.expr]()
        found = self.named(ast.unparse(node.func)) if by_name else self.of_module(node.func)
        if found is ... and isinstance(node.func, ast.Attribute):  # a method
            owner = [node.func.value]
        elif not isinstance(found, FunctionType):
            return self.builtin(found, node)
        given = self.several([*owner, *node.args, *(each.value for each in node.keywords)])
        if owner and isinstance(node.func, ast.Attribute):
            of = getattr(given[0].type, "owner", None)
            found = self._program.look(partial(inspect.getattr_static, of, node.func.attr, None))
        if not isinstance(found, FunctionType):
            raise self.error(node, f"a call of {ast.unparse(node.func)}")
        first = len(given) - len(node.keywords)
        names = [each.arg or "*" for each in node.keywords]
        return self.call(found, given[:first], dict(zip(names, given[first:], strict=True)), node)

    def call(self, function: FunctionType, given: list[Value], by_name: Mapping[str, Value], node: ast.AST) -> Value:
        rare = getattr(getattr(given[0].type, "owner", None), "RARE", ()) if given else ()
        if function.__name__ in rare:
            return self.call_back(given[0], rare.index(function.__name__), given[1:], node)
        parameters = inspect.signature(function).parameters
        defaults = {name: each.default for name, each in parameters.items() if each.default is not each.empty}
        rest = [*parameters][len(given) :]
        if len(given) > len(parameters) or not by_name.keys() <= {*rest} <= by_name.keys() | defaults.keys():
            raise self.error(node, f"a call of {function.__qualname__} with other arguments")
        given = [*given, *(by_name[name] if name in by_name else self.known(defaults[name], node) for name in rest)]
        name, result = self._program.function(function, [each.type for each in given])
        text = f"{name}({', '.join(self.one(each) for each in given if each.type != NONE)})"
        if result == VOID:
            self.emit(f"{text};", f"if (fault) {LEAVE}")
            return constant(None)
        found = self.saved(Value(result, text))
        self.emit(f"if (fault) {LEAVE}")
        return found

    def call_back(self, thing: Value, which: int, given: Sequence[Value], node: ast.AST) -> Value:
        """Call of a rare function of an object, in Python, with numbers; it returns nothing."""
        parts = [part for each in given for part in (self.parts(each, node) if each.type != DOUBLE else [each])]
        numbers, name = ", ".join(self.of_type(each, DOUBLE, node).text for each in parts), self.new()
        self.emit(
            f"double {name}[] = {{{numbers}}};",
            f"if (back((whole){thing.text}, {which}, {name})) {{ fault = 1; {LEAVE} }}",
        )
        return constant(None)

    def builtin(self, found: Any, node: ast.Call) -> Value:  # noqa: PLR0911 - one for each sort
        """Value of a function of `math`, or of one that Python has by itself."""
        name, called = getattr(found, "__name__", ""), ast.unparse(node.func)
        of_math = name in MATH and getattr(math, name) is found
        if not of_math and not (name in BUILTINS and getattr(builtins, name) is found):
            raise self.error(node, called if called.startswith("math.") else f"a call of {called}")
        several, given = name in ("min", "max", "atan2", "copysign"), self.several(node.args)
        if node.keywords or not given or (len(given) > 1 and not several):
            raise self.error(node, "round to digits" if name == "round" else f"a call of {called} with other arguments")
        first = given[0]
        if of_math and MATH[name] == first.type == WHOLE:
            return first
        if of_math:
            return Value(MATH[name], f"py_{name}({', '.join(self.number(each, DOUBLE, node).text for each in given)})")
        if several:
            values = self.parts(first, node) if len(given) == 1 else given
            kind, text = values[0].type, values[0].text
            for each in values[1:]:
                text = f"py_{name}{'_i' * (kind == WHOLE)}({text}, {self.of_type(each, kind, node).text})"
            return self.number(Value(kind, text), kind if kind == WHOLE else DOUBLE, node)
        if name == "len":
            items = isinstance(first.type, Items)
            return Value(WHOLE, f"{first.text}.count") if items else constant(len(self.parts(first, node)))
        if name == "bool":
            return self.truth(first, node)
        if name == "float" or first.type != DOUBLE:
            whole = self.number(first, DOUBLE if name == "float" else WHOLE, node)
            return Value(WHOLE, f"py_abs_i({whole.text})") if name == "abs" else whole
        return Value(DOUBLE if name == "abs" else WHOLE, f"py_{name}({first.text})")


def _calls(node: ast.AST) -> bool:
    return any(isinstance(each, ast.Call) for each in ast.walk(node))


def _overlap(targets: Sequence[str], texts: Sequence[str]) -> bool:
    """Whether setting one of several targets may change a value that is still to be read."""
    read, memory = set(re.findall(r"\w+", " ".join(texts))), any("->" in each or "[" in each for each in texts)
    return len(targets) > 1 and any(mangled(each) in read or (memory and not each.isidentifier()) for each in targets)
