"""Expressions in C: each visit gives a `Value`, and emits the statements that come before it."""

from __future__ import annotations

import ast
import builtins
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import FunctionType, ModuleType
from typing import Any, Final, Protocol

from agents.plugins.law import Control
from experiments.virtual_time.records import FLOAT, INT, Items, RecordLayout
from experiments.virtual_time.translator.kinds import (
    ALL_BITS,
    BOOLEAN,
    DOUBLE,
    NAME,
    NONE,
    WHOLE,
    WORD,
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
    valueless,
)

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
GIVEN: Final = ("", "velocity", "goal")  # what a `Control` gives, by number
SMALL: Final = 1 << 31  # a sum with a constant below this needs no check
NAMED: Final[dict[type, str]] = {  # constructs outside of the subset
    ast.JoinedStr: "an f-string", ast.Dict: "a dictionary", ast.Set: "a set", ast.List: "a list", ast.Try: "try",
    ast.ListComp: "a comprehension", ast.SetComp: "a comprehension", ast.DictComp: "a comprehension", ast.With: "with",
    ast.GeneratorExp: "a generator", ast.Lambda: "a lambda", ast.Starred: "*args", ast.Delete: "del",
    ast.FunctionDef: "a function within it", ast.Slice: "a slice",
}  # fmt: skip


class Translated(Protocol):
    """Program that functions belong to."""

    names: Mapping[str, int]
    measures: list[str]
    called_back: dict[str, str]

    def c(self, kind: Any) -> str:
        """C's name of a type."""

    def look(self, get: Callable[..., Any], place: Any, name: str, default: Any = ...) -> Any:
        """Present meaning of a name."""

    def function(self, function: FunctionType, types: Sequence[Any]) -> tuple[str, Any]:
        """C's name of a function for arguments of these types, and the type of its result."""


class Expressions(ast.NodeVisitor):
    """Walk through a function; a visit of an expression gives its `Value`."""

    def __init__(
        self, program: Translated, tree: ast.FunctionDef, space: dict[str, Any], function: FunctionType | None = None
    ) -> None:
        self._program, self._tree, self._space, self._function = program, tree, space, function
        self._lines = list[str]()
        self._count, self._ended = 0, False
        self._locals, self._set = dict[str, Any](), set[str]()  # types, and names that have a value here in any case
        self._result: Any = None  # type
        self._names = dict[str, str]()  # names in C of variables of comprehensions
        self.arguments: dict[str, Any] = {}

    def error(self, node: ast.AST, what: str) -> OutsideError:
        if self._function is None:
            return OutsideError(f"{what}: {ast.unparse(node)}")
        where = place(self._function, getattr(node, "lineno", 1))
        return OutsideError(f"{where}: {self._function.__qualname__} uses {what}")

    def generic_visit(self, node: ast.AST) -> Any:
        raise self.error(node, NAMED.get(type(node), f"`{ast.unparse(node)[:40]}`"))

    def emit(self, *lines: str) -> None:
        self._lines += lines

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
        parts = [self.one(each) for each in value.parts if has_value(each.type)]
        return f"({self._program.c(value.type)}){{{', '.join(parts) or '0'}}}"

    def parts(self, value: Value, node: ast.AST) -> Sequence[Value]:
        """Parts of a tuple."""
        if not isinstance(value.type, Several) or value.type.owner is not tuple:
            raise self.error(node, "parts of something that is no tuple")
        return self.members(value)

    def members(self, value: Value) -> Sequence[Value]:
        if value.parts is not None:
            return value.parts
        kinds = enumerate(value.type.parts)
        return [Value(each, f"{value.text}._{k}") if has_value(each) else valueless(each) for k, each in kinds]

    def of_type(self, value: Value, kind: Any, node: ast.AST) -> Value:
        """The value; raises OutsideError if it has another type."""
        if value.type != kind:
            raise self.error(node, f"{listed(value.type)} where {listed(kind)} stands otherwise")
        return value

    def number(self, value: Value, kind: str, node: ast.AST) -> Value:
        """The value as a number of this type, as Python's arithmetic takes it."""
        if value.type == kind:
            return value
        if value.type == WORD and kind == DOUBLE:
            return Value(DOUBLE, f"py_of_word({value.text})")
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
        if isinstance(value.type, Several) and value.type.owner in (tuple, dict):
            return constant(bool(value.type.parts))
        if isinstance(value.type, RecordLayout):
            if any(hasattr(value.type.owner, name) for name in ("__bool__", "__len__")):
                raise self.error(node, "the truth of an object")
            return constant(True)
        if isinstance(value.type, Items | Made):
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
            return Value(kind, self._names.get(node.id) or mangled(node.id)) if has_value(kind) else valueless(kind)
        return self.known(self.named(node.id), node)

    def named(self, name: str) -> Any:
        """Meaning of a name outside of the function, ... if it has none."""
        return self._program.look(dict.get, self._space, name, getattr(builtins, name, ...))

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
                return self._program.look(getattr, owner, node.attr, None)
        return ...

    def visit_Subscript(self, node: ast.Subscript) -> Value:
        if isinstance(node.slice, ast.Slice):
            parts, ends = (
                self.parts(self.visit(node.value), node),
                (node.slice.lower, node.slice.upper, node.slice.step),
            )
            kept = parts[slice(*(None if each is None else ast.literal_eval(each) for each in ends))]
            return Value(Several(tuple(each.type for each in kept)), "", ..., kept)
        items, k = self.several([node.value, node.slice])
        if isinstance(items.constant, Mapping) and k.constant in items.constant:
            return self.known(items.constant[k.constant], node)
        if isinstance(k.type, TextType) and isinstance(items.type, Several) and items.type.owner is dict:
            if k.constant not in items.type.names:
                raise self.error(node, f"{k.constant}, which a dictionary lacks")
            return self.members(items)[items.type.names.index(k.constant)]
        if isinstance(items.type, Several) and isinstance(k.constant, int):
            parts = self.parts(items, node)
            if not -len(parts) <= k.constant < len(parts):
                raise self.error(node, "an index outside of a tuple")
            return parts[k.constant]
        return self.item(self.as_list(items, node), k, node)

    def visit_Dict(self, node: ast.Dict) -> Value:
        """A dictionary of constant texts: a value with names, in their order of letters."""
        names = [each.value if isinstance(each, ast.Constant) else None for each in node.keys]
        texts = [each for each in names if isinstance(each, str)]
        if len({*texts}) < len(names):
            raise self.error(node, "a dictionary without texts as keys")
        values = dict(zip(texts, self.several(node.values), strict=True))
        return self.with_names(dict, {name: values[name] for name in sorted(values)})

    def with_names(self, owner: type, values: Mapping[str, Value]) -> Value:
        kinds = tuple(each.type for each in values.values())
        return Value(Several(kinds, (*values,), owner), "", ..., (*values.values(),))

    def as_list(self, value: Value, node: ast.AST) -> Value:
        """A list, or a tuple of numbers of one type as one."""
        if not isinstance(value.type, Several):
            return value
        (kind, *others), name = [each.type for each in self.parts(value, node)] or [NONE], self.new()
        if kind not in (DOUBLE, WHOLE) or any(each != kind for each in others):
            raise self.error(node, "a loop over, or an index of, a tuple of several types")
        items = Items(FLOAT if kind == DOUBLE else INT)
        self.emit(f"{kind} {name}[] = {{{', '.join(self.one(each) for each in self.parts(value, node))}}};")
        return Value(items, f"(({self._program.c(items)}){{{name}, {len(others) + 1}}})")

    def item(self, items: Value, k: Value, node: ast.AST) -> Value:
        """Item of a list; the function ends at an index that is not within it."""
        if not isinstance(items.type, Items | Made):
            raise self.error(node, f"an index of {listed(items.type)}")
        name, count = self.new(), f"{items.text}.count"
        self.emit(f"whole {name} = {self.number(k, WHOLE, node).text};")
        if k.constant is ... or k.constant < 0:
            self.emit(f"if ({name} < 0) {name} += {count};")
        self.emit(f"if ((unsigned long long){name} >= (unsigned long long){count}) fail();")
        return Value(item_of(items.type), f"{items.text}.at[{name}]")

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
        op = type(node.op)
        if op is ast.BitAnd and not calls(node) and self.aside(partial(self.visit, node.right))[0].constant == ALL_BITS:
            return Value(WORD, self.modulo(node.left))
        a, b = self.several([node.left, node.right])
        if a.type == WORD and (b.type == WORD and op in BITS):
            return Value(WORD, f"({a.text} {BITS[op]} {b.text})")
        if a.type == WORD and op is ast.RShift and b.constant in range(64):
            return Value(WORD, f"({a.text} >> {b.constant})")
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

    def modulo(self, node: ast.expr) -> str:
        """Sums, products and bits modulo 2⁶⁴."""
        if isinstance(node, ast.BinOp) and type(node.op) in SUMS | BITS:
            return f"({self.modulo(node.left)} {(SUMS | BITS)[type(node.op)]} {self.modulo(node.right)})"
        found = self.visit(node)
        if found.type not in (WHOLE, WORD):
            raise self.error(node, f"{listed(found.type)} where a whole number belongs")
        return f"(word)({found.text})"

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
            if any(map(calls, values[1:-1])):
                raise self.error(node, "a call within a chain of comparisons")
            each: list[ast.expr] = [
                ast.Compare(a, [op], [b]) for a, op, b in zip(values, node.ops, values[1:], strict=False)
            ]
            whole = ast.BoolOp(ast.And(), [ast.copy_location(pair, node) for pair in each])
            return self.joined(ast.copy_location(whole, node), self.visit)
        (a, b), op = self.several(values), type(node.ops[0])
        identity, word = op in (ast.Is, ast.IsNot), COMPARISONS.get(op, "")
        if b.type == NONE and word and isinstance(node.left, ast.Attribute):  # a velocity or goal may be left out
            of = self.visit(node.left.value)
            if getattr(of.type, "owner", None) is Control and node.left.attr in GIVEN:
                gives = self.members(of)[of.type.names.index("gives")]
                return Value(BOOLEAN, f"({gives.text} {'!=' if word == '==' else '=='} {GIVEN.index(node.left.attr)})")
        if NONE in (a.type, b.type) and word:
            return constant((a.type == b.type) == (word == "=="))
        if isinstance(a.type, TextType) and isinstance(b.type, TextType) and op in (ast.Eq, ast.NotEq):
            return constant((a.constant == b.constant) == (op is ast.Eq))
        if {type(a.type), type(b.type)} == {str, TextType} and NAME in (a.type, b.type) and op in (ast.Eq, ast.NotEq):
            name, text = (a, b) if isinstance(b.type, TextType) else (b, a)
            return Value(BOOLEAN, f"({name.text} {word} {self._program.names.get(text.constant, -1)})")
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


def calls(node: ast.AST) -> bool:
    return any(isinstance(each, ast.Call) for each in ast.walk(node))
