"""Calls and attributes in C: functions, methods, properties, functions of `math` and of Python itself."""

# ruff: noqa: N802 - named by the visitor
from __future__ import annotations

import ast
import builtins
import inspect
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from types import FunctionType
from typing import Any, Final

from agents.decision.neighbours import Neighbour
from agents.decision.stepping import REST
from agents.plugins.law import Control, NeighbourView, RobotFacts, View
from agents.vectors import UNKNOWN
from experiments.virtual_time.records import FLOAT, MEASURES, Items, Measured, RecordLayout, numbers
from experiments.virtual_time.translator.expressions import GIVEN, NAMED, Expressions
from experiments.virtual_time.translator.kinds import (
    BOOLEAN,
    DOUBLE,
    NAME,
    NONE,
    VOID,
    WHOLE,
    Made,
    OutsideError,
    Several,
    Value,
    constant,
    has_value,
    listed,
    mangled,
    type_of,
)

OF_FLOATS: Final = "sqrt sin cos tan asin acos atan atan2 log log1p exp expm1 tanh fabs copysign degrees radians"
MATH: Final = {  # functions of `math`, with the types of their values
    **dict.fromkeys(OF_FLOATS.split(), DOUBLE), **dict.fromkeys(("floor", "ceil", "trunc"), WHOLE),
    **dict.fromkeys(("isfinite", "isinf", "isnan"), BOOLEAN),
}  # fmt: skip
BUILTINS: Final = {"abs", "bool", "float", "int", "len", "max", "min", "round"}
NEW_SUMS: Final = (3, 12)  # Python that adds floats in another way
NUMBER_OF: Final[dict[type, str]] = {RobotFacts: "number", Neighbour: "sender"}  # attribute with the number of a name


@cache
def parameters_of(function: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(function).parameters


class Calls(Expressions):
    """Walk through a function, with its calls."""

    def visit_Attribute(self, node: ast.Attribute) -> Value:  # noqa: PLR0911 - one for each sort
        if (found := self.of_module(node)) is not ...:
            return self.known(found, node)
        thing = self.visit(node.value)
        layout, name = thing.type, node.attr
        if isinstance(layout, Several) and name in layout.names and layout.owner is not dict:
            return self.members(thing)[layout.names.index(name)]
        if name == "name" and (number := NUMBER_OF.get(getattr(layout, "owner", tuple))):
            return Value(NAME, f"{thing.text}->{number}")
        if not isinstance(layout, RecordLayout):
            raise self.error(node, f"an attribute of {listed(layout)}")
        if name in layout.fields:
            return Value(type_of(layout.fields[name]), f"{thing.text}->{mangled(name)}")
        if name in layout.fixed:
            empty = name in getattr(layout.owner, "NAMED", ())
            return self.with_names(dict, {}) if empty else self.known(layout.fixed[name], node)
        found = self._program.look(inspect.getattr_static, layout.owner, name)
        if isinstance(found, property) and isinstance(found.fget, FunctionType):
            return self.call(found.fget, [thing], {}, node)
        if found is ...:
            raise self.error(node, f"an attribute {name} that is not there")
        return self.known(found, node)

    def visit_Call(self, node: ast.Call) -> Value:
        is_name, owner = isinstance(node.func, ast.Name) and node.func.id not in self._locals, list[ast.expr]()
        found = self.named(ast.unparse(node.func)) if is_name else self.of_module(node.func)
        if found is ... and isinstance(node.func, ast.Attribute):  # a method
            owner = [node.func.value]
        elif not isinstance(found, FunctionType) or found is numbers:
            return self.builtin(found, node)
        given, by_name = self.given(node, owner)
        if owner and isinstance(node.func, ast.Attribute):
            if isinstance(given[0].constant, Mapping) and node.func.attr == "get":
                if isinstance(given[1].constant, str) and len(given) == 3:
                    known, key = given[0].constant, given[1].constant
                    return self.known(known[key], node) if key in known else given[2]
                if len(given) != 3 or given[2].type == NONE:
                    raise self.error(node, "`get` without a default")
                return self.entry(given[0], given[1], given[2], node)
            of = getattr(given[0].type, "owner", None)
            if node.func.attr in getattr(of, "CHECKS", ()):  # the types of values are checked here
                return given[1]
            found = self._program.look(inspect.getattr_static, of, node.func.attr)
        if not isinstance(found, FunctionType):
            raise self.error(node, f"a call of {ast.unparse(node.func)}")
        if found is RobotFacts.of and isinstance(given[1].constant, Mapping):
            name, default = Value(NAME, f"{given[0].text}->number"), (*given[2:], *by_name.values(), constant(None))[0]
            return self.entry(given[1], name, default, node)
        return self.call(found, given, by_name, node)

    def entry(self, table: Value, name: Value, default: Value, node: ast.AST) -> Value:
        """Value of a robot in a constant table by names; without a default it must be there."""
        numbers, found = self._program.names, self.new()
        rows = {numbers[each]: constant(value) for each, value in table.constant.items() if each in numbers}
        kinds = {each.type for each in (default, *rows.values()) if each.type != NONE}
        if name.type != NAME or len(kinds) != 1 or not has_value(kind := kinds.pop()):
            raise self.error(node, f"a table of {' or '.join(sorted(map(listed, kinds)))}")
        self.emit(f"{self._program.c(kind)} {found};", f"switch ({name.text}) {{")
        self.emit(*(f"case {row}: {found} = {self.one(value)}; break;" for row, value in rows.items()))
        other = "fail();" if default.type == NONE else f"{found} = {self.one(default)};"
        self.emit(f"default: {other}", "}")
        return Value(kind, found)

    def given(self, node: ast.Call, owner: Sequence[ast.expr] = ()) -> tuple[list[Value], dict[str, Value]]:
        """Arguments of a call by place, behind its owner, and by name."""
        nodes = [*owner, *node.args, *(each.value for each in node.keywords)]
        values = self.several([each.value if isinstance(each, ast.Starred) else each for each in nodes])
        first = len(values) - len(node.keywords)
        places = list[Value]()
        for argument, value in zip(nodes[:first], values[:first], strict=True):
            places += self.parts(value, node) if isinstance(argument, ast.Starred) else [value]
        return places, dict(zip([each.arg or "*" for each in node.keywords], values[first:], strict=True))

    def call(self, function: FunctionType, given: list[Value], by_name: Mapping[str, Value], node: ast.AST) -> Value:
        owner = getattr(given[0].type, "owner", None) if given else None
        if function.__name__ in getattr(owner, "IN_PYTHON", ()):
            return self.call_back(given[0], 0, given[1:], node)
        rare = getattr(owner, "RARE", ())
        if function.__name__ not in rare:
            return self.call_quiet(function, given, by_name, node)
        program, name = self._program, function.__qualname__
        mark = len(self._lines)
        if name not in program.called_back:
            try:
                self.emit("rooms = 0;")
                return self.call_quiet(function, given, by_name, node)
            except OutsideError as error:
                del self._lines[mark:]
                program.called_back[name] = str(error)
        return self.call_back(given[0], rare.index(function.__name__), given[1:], node)

    def call_quiet(
        self, function: FunctionType, given: list[Value], by_name: Mapping[str, Value], node: ast.AST
    ) -> Value:
        parameters = parameters_of(function)
        several = any(each.kind is each.VAR_POSITIONAL for each in parameters.values())
        defaults = {name: each.default for name, each in parameters.items() if each.default is not each.empty}
        rest = [] if several else [*parameters][len(given) :]
        if (len(given) > len(parameters) and not several) or not by_name.keys() <= {
            *rest
        } <= by_name.keys() | defaults.keys():
            raise self.error(node, f"a call of {function.__qualname__} with other arguments")
        given = [*given, *(by_name[name] if name in by_name else self.known(defaults[name], node) for name in rest)]
        name, result = self._program.function(function, [each.type for each in given])
        texts = [self.one(each) for each in given if has_value(each.type)]
        if several:
            fixed = len(parameters) - 1
            more = Value(Several(tuple(each.type for each in given[fixed:])), "", ..., given[fixed:])
            texts = [self.one(each) for each in (*given[:fixed], more) if has_value(each.type)]
        text = f"{name}({', '.join(texts)})"
        if result == VOID:
            self.emit(f"{text};")
            return constant(None)
        return self.saved(Value(result, text))

    def call_back(self, thing: Value, which: int, given: Sequence[Value], node: ast.AST) -> Value:
        """Call of a rare function of an object, in Python, with numbers: objects are there; it returns nothing."""
        values = [each for each in given if not isinstance(each.type, RecordLayout)]
        several = [self.parts(each, node) if isinstance(each.type, Several) else [each] for each in values]
        parts = [part for each in several for part in each]
        numbers, name = ", ".join(self.of_type(each, DOUBLE, node).text for each in parts), self.new()
        self.emit(f"double {name}[] = {{{numbers or '0.0'}}};")
        self.emit(f"if (back((whole){thing.text}, {which}, {name})) fail();")
        return constant(None)

    def builtin(self, found: Any, node: ast.Call) -> Value:  # noqa: PLR0911, PLR0912 - one for each sort
        """Value of a function of `math`, or of one that Python has by itself."""
        name, called = getattr(found, "__name__", ""), ast.unparse(node.func)
        if found in (View, NeighbourView, Control):
            return self.made(found, node)
        if found is numbers:
            return self.all_numbers(self.visit(node.args[0]), node)
        if found is dict and len(node.args) == 1:
            return self.floats_of(self.visit(node.args[0]), node)
        if found is tuple and len(node.args) == 1 and ast.unparse(node.args[0]).startswith("map("):
            return self.mapped(node.args[0], node)
        if found in (math.hypot, math.dist):
            return self.length(found, node)
        if found is float and len(node.args) == 1 and isinstance(node.args[0], ast.JoinedStr):
            return self.digits(node.args[0])
        of_math = name in MATH and getattr(math, name) is found
        if not of_math and not (name in BUILTINS and getattr(builtins, name) is found):
            raise self.error(node, called if called.startswith("math.") else f"a call of {called}")
        several, given = name in ("min", "max", "atan2", "copysign"), self.several(node.args)
        if node.keywords or not given or (len(given) > 1 and not several):
            raise self.error(node, "round to digits" if name == "round" else f"a call of {called} with other arguments")
        first = given[0]
        if found is float and first.constant in ("nan", "inf"):
            return constant(float(first.constant))
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
            items = isinstance(first.type, Items | Made)
            return Value(WHOLE, f"{first.text}.count") if items else constant(len(self.parts(first, node)))
        if name == "bool":
            return self.truth(first, node)
        if name == "float" or first.type != DOUBLE:
            whole = self.number(first, DOUBLE if name == "float" else WHOLE, node)
            return Value(WHOLE, f"py_abs_i({whole.text})") if name == "abs" else whole
        return Value(DOUBLE if name == "abs" else WHOLE, f"py_{name}({first.text})")

    def mapped(self, node: Any, call: ast.Call) -> Value:
        """`tuple(map(function, values))` of a tuple."""
        function = self.named(ast.unparse(node.args[0]))
        if len(node.args) != 2 or not isinstance(function, FunctionType):
            raise self.error(call, "a call of tuple")
        parts = [self.call(function, [each], {}, node) for each in self.parts(self.visit(node.args[1]), node)]
        return Value(Several(tuple(each.type for each in parts)), "", ..., parts)

    def made(self, owner: Any, node: ast.Call) -> Value:
        """An object that is a value."""
        places, by_name = self.given(node)
        parameters = parameters_of(owner)
        given = dict(zip(parameters, places, strict=False)) | by_name
        if len(given) < len(places) + len(by_name) or not given.keys() <= parameters.keys():
            raise self.error(node, f"a call of {owner.__name__} with other arguments")
        if owner is Control:
            return self.control(given, node)
        values = {
            name: given[name] if name in given else self.known(parameters[name].default, node) for name in parameters
        }
        return self.with_names(owner, values)

    def control(self, given: Mapping[str, Value], node: ast.Call) -> Value:
        """A `Control`: of a velocity or goal that is left out, `gives` knows, and `measured` of measures."""
        nothing = self.with_names(dict, {})
        memory, measures = given.get("memory", nothing), given.get("measures", nothing)
        values = {"memory": self.floats_of(memory, node)}
        gives = measured = 0
        for k, (name, other) in enumerate(zip(GIVEN[1:], (REST, UNKNOWN), strict=True), 1):
            value = given.get(name, constant(None))
            gives = gives if value.type == NONE else k if gives == 0 else 3
            values[name] = self.floats(constant(other) if value.type == NONE else value, node)
        measure, known = [constant(0.0)] * MEASURES, self._program.measures
        for name, value in zip(measures.type.names, self.members(measures), strict=True):
            if name not in known:
                known.append(name)
            if known.index(name) >= MEASURES or gives > 2 or len(values["velocity"].type.parts) != 3:
                raise self.error(node, f"more than {MEASURES} measures, or a velocity beside a goal")
            measure[known.index(name)] = self.number(value, DOUBLE, node)
            measured |= 1 << known.index(name)
        values["yaw"] = self.number(given.get("yaw", constant(math.nan)), DOUBLE, node)
        values["measures"] = Value(type_of(Measured()), "", ..., [constant(float(measured)), *measure])
        return self.with_names(Control, values | {"gives": constant(gives)})

    def floats(self, value: Value, node: ast.AST) -> Value:
        """A tuple of floats."""
        parts = [self.number(each, DOUBLE, node) for each in self.parts(value, node)]
        return Value(Several((DOUBLE,) * len(parts)), "", ..., parts)

    def floats_of(self, value: Value, node: ast.AST) -> Value:
        """A dictionary of tuples of floats."""
        if not isinstance(value.type, Several) or value.type.owner is not dict:
            raise self.error(node, f"{listed(value.type)} where a dictionary belongs")
        members = zip(value.type.names, self.members(value), strict=True)
        return self.with_names(dict, {name: self.floats(each, node) for name, each in members})

    def all_numbers(self, value: Value, node: ast.AST) -> Value:
        """All numbers of a dictionary, as a list where they stand; see `numbers`."""
        if not isinstance(value.type, Several) or value.type.owner not in (dict, Measured):
            raise self.error(node, f"numbers of {listed(value.type)}")
        items, count = Items(FLOAT), f"(sizeof {value.text} / 8)" if value.type.parts else "0"
        at = f"(double *)&{value.text}" if value.type.parts else "(double *)0"
        return Value(items, f"(({self._program.c(items)}){{{at}, {count}}})")

    def length(self, found: Any, node: ast.Call) -> Value:
        """`hypot` and `dist`: Python's own sums, which it changed."""
        given = self.several(node.args)
        if found is math.dist:
            a, b = (self.floats(each, node).parts for each in given)
            given = [Value(DOUBLE, f"({x.text} - {y.text})") for x, y in zip(a or (), b or (), strict=True)]
        if sys.version_info >= NEW_SUMS:
            raise self.error(node, f"{ast.unparse(node.func)}, of which this Python has another last digit")
        values = [self.number(each, DOUBLE, node).text for each in given]
        return Value(DOUBLE, f"py_hypot({len(values)}, (double[]){{{', '.join(values)}}})")

    def digits(self, node: ast.JoinedStr) -> Value:
        """`float(f"{x:.7g}")`."""
        (shown,) = node.values if len(node.values) == 1 else [None]
        spec = getattr(shown, "format_spec", None)
        parts = [each.value for each in getattr(spec, "values", ())]
        texts = [str(each if isinstance(each, str) else self.visit(each).constant) for each in parts]
        if not isinstance(shown, ast.FormattedValue) or not re.fullmatch(r"\.\d+g", "".join(texts)):
            raise self.error(node, NAMED[ast.JoinedStr])
        value = self.number(self.visit(shown.value), DOUBLE, node)
        return Value(DOUBLE, f"py_digits({value.text}, {''.join(texts)[1:-1]})")
