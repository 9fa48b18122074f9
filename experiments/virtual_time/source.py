"""Source of quiet functions, as a compiler gets it: for objects of which some attributes are constants.

`x.y is None` is decided, what that rules out is left out, and loops over lists count. What plug-ins of others do is
held to the subset that gives the same bits (`faults`), with the errors that Python raises (`STRICT`).
"""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import textwrap
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from types import CodeType
from typing import Any, Final

OURS: Final = frozenset(
    {"agents", "twins", "experiments"}
)  # packages with quiet functions that tests hold to the subset
BANNED: Final[dict[type, str]] = {
    ast.JoinedStr: "an f-string", ast.Dict: "a dictionary", ast.Set: "a set", ast.ListComp: "a comprehension",
    ast.SetComp: "a comprehension", ast.DictComp: "a comprehension", ast.GeneratorExp: "a generator",
    ast.Lambda: "a lambda", ast.Try: "try", ast.With: "with", ast.Yield: "yield", ast.YieldFrom: "yield",
    ast.Await: "await", ast.Raise: "raise", ast.Assert: "assert", ast.Starred: "*args", ast.Delete: "del",
    ast.Global: "global", ast.Nonlocal: "nonlocal", ast.Import: "an import", ast.ImportFrom: "an import",
}  # fmt: skip
BUILTINS: Final = frozenset({"abs", "bool", "float", "int", "len", "max", "min", "range", "round"})
POWER: Final = "_power"  # stands for **
RESERVED: Final = {"view"}  # attributes that mean something else to the compiler
PREFIX: Final = "its_"  # in front of those


def is_foreign(function: Callable[..., Any]) -> bool:
    """Whether a function or class is of a plug-in of others."""
    return str(function.__module__).partition(".")[0] not in OURS


def faults(definition: ast.FunctionDef) -> Iterator[tuple[int, str]]:
    """Constructs of a function outside of the subset, each with its line in the source."""
    body = [each for each in definition.body if not _is_text(each)]
    if len(body) == 1 and isinstance(body[0], ast.Raise):
        return  # a method that must be defined
    if definition.args.vararg or definition.args.kwarg:
        yield definition.lineno, "*args"
    for statement in body:
        for node in ast.walk(statement):
            if found := _fault(node):
                yield getattr(node, "lineno", statement.lineno), found


@cache
def outside(owner: type) -> tuple[str, ...]:
    """Constructs outside of the subset in methods of a plug-in of others, each with its place."""
    found = []
    for function in {name: getattr(owner, name, None) for name in dir(owner) if name != "__init__"}.values():
        if inspect.isfunction(function) and is_foreign(function):
            with suppress(OSError, SyntaxError):  # has no source; the compiler says so
                definition = _definition(function)
                name = function.__qualname__
                found += [f"{place(function, line)}: {name} uses {fault}" for line, fault in faults(definition)]
    return tuple(found)


def _definition(function: Callable[..., Any]) -> ast.FunctionDef:
    """A function in its source; raises SyntaxError or OSError for one without a source of its own."""
    definition = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    if not isinstance(definition, ast.FunctionDef):
        raise SyntaxError(f"{function.__qualname__} is no plain function")
    return definition


def _is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def _fault(node: ast.AST) -> str:  # noqa: PLR0911 - one for each sort
    if type(node) in BANNED:
        return BANNED[type(node)]
    if isinstance(node, ast.Constant) and node.value is None:
        return "None"
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return f"the text {node.value[:20]!r}"
    if isinstance(node, ast.Name) and node.id in {"np", "numpy"}:
        return "numpy"
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "math":
        return "" if node.attr in SAFE or node.attr in STRICT else f"math.{node.attr}"
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return _faulty_call(node.func.id, len(node.args))
    return ""


def _faulty_call(name: str, arguments: int) -> str:
    if name == "round" and arguments > 1:
        return "round to digits"
    return f"a call of {name}" if hasattr(builtins, name) and name not in BUILTINS else ""


def specialised(function: Callable[..., Any], fixed: Mapping[str, Any]) -> tuple[CodeType, set[str]]:
    """Code of a module that defines the function, and the names that it uses.

    `fixed`: constant attributes of its first argument, with their values. Raises SyntaxError or OSError for a function
    without source of its own, or outside of the subset.
    """
    definition = _definition(function)
    tree = ast.Module([definition], [])
    if is_foreign(function):
        tree = Powers().visit(tree)
    arguments = definition.args
    definition.decorator_list, definition.returns = [], None
    for each in (*arguments.args, *arguments.kwonlyargs):
        each.annotation = None
    owner = arguments.args[0].arg if arguments.args else ""
    tree = ast.fix_missing_locations(Specialised(owner, fixed).visit(tree))
    if is_foreign(function):
        for line, fault in faults(definition):
            raise SyntaxError(f"{place(function, line)}: {function.__qualname__} uses {fault}")
    ast.increment_lineno(tree, function.__code__.co_firstlineno - 1)
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    return compile(tree, function.__code__.co_filename, "exec"), names


def place(function: Callable[..., Any], line: int = 1) -> str:
    """File and line of a function, at line `line` of its source."""
    code = inspect.unwrap(function).__code__
    return f"{code.co_filename}:{code.co_firstlineno + line - 1}"


def _sqrt(x: float) -> float:
    if x < 0.0:
        raise ValueError("math domain error")
    return math.sqrt(x)


def _asin(x: float) -> float:
    if abs(x) > 1.0:
        raise ValueError("math domain error")
    return math.asin(x)


def _acos(x: float) -> float:
    if abs(x) > 1.0:
        raise ValueError("math domain error")
    return math.acos(x)


def _sin(x: float) -> float:
    if abs(x) == math.inf:
        raise ValueError("math domain error")
    return math.sin(x)


def _cos(x: float) -> float:
    if abs(x) == math.inf:
        raise ValueError("math domain error")
    return math.cos(x)


def _tan(x: float) -> float:
    if abs(x) == math.inf:
        raise ValueError("math domain error")
    return math.tan(x)


def _log(x: float) -> float:
    if x <= 0.0:
        raise ValueError("math domain error")
    return math.log(x)


def _exp(x: float) -> float:
    found = math.exp(x)
    if found == math.inf and x < math.inf:
        raise OverflowError("math range error")
    return found


def _expm1(x: float) -> float:
    found = math.expm1(x)
    if found == math.inf and x < math.inf:
        raise OverflowError("math range error")
    return found


def _floor(x: float) -> int:
    return math.floor(_whole(x))


def _ceil(x: float) -> int:
    return math.ceil(_whole(x))


def _int(x: float) -> int:
    return int(_whole(x))


def _round(x: float) -> int:
    return round(_whole(x))


def _whole(x: float) -> float:
    """A number with a whole part that fits into a word."""
    if not abs(x) < LARGEST_WHOLE:
        raise ValueError("it has no whole part")
    return x


LARGEST_WHOLE: Final = 2.0**62
# functions that raise as those of Python do, or sooner: an error ends a compiled stretch, and Python tells it
STRICT: Final[dict[str, Callable[..., Any]]] = {
    "sqrt": _sqrt, "asin": _asin, "acos": _acos, "sin": _sin, "cos": _cos, "tan": _tan, "log": _log, "exp": _exp,
    "expm1": _expm1, "floor": _floor, "ceil": _ceil, "int": _int, "trunc": _int, "round": _round,
}  # fmt: skip
SAFE: Final = frozenset({  # functions and constants of `math` that are the same, whatever they are given
    "atan", "atan2", "copysign", "degrees", "e", "fabs", "inf", "isfinite", "isinf", "isnan", "nan", "pi", "radians",
    "tanh", "tau",
})  # fmt: skip


class Powers(ast.NodeTransformer):
    """Powers as calls: a compiler would turn x ** 2 into x * x, which is not always the same. No annotations."""

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        self.generic_visit(node)
        made = ast.Pass() if node.value is None else ast.Assign([node.target], node.value)
        return ast.copy_location(made, node)

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        self.generic_visit(node)
        return self._power(node.left, node.right) if isinstance(node.op, ast.Pow) else node

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.AST:
        self.generic_visit(node)
        if not (isinstance(node.op, ast.Pow) and isinstance(node.target, ast.Name)):
            return node
        base = ast.Name(node.target.id, ast.Load())
        return ast.copy_location(ast.Assign([node.target], self._power(base, node.value)), node)

    def _power(self, base: ast.expr, exponent: ast.expr) -> ast.Call:
        call = ast.Call(ast.Name(POWER, ast.Load()), [base, exponent], [])
        return ast.fix_missing_locations(ast.copy_location(call, base))


class Specialised(ast.NodeTransformer):
    """Function for a first argument of which some attributes are constants."""

    def __init__(self, owner: str, fixed: Mapping[str, Any]) -> None:
        self._owner, self._fixed, self._loops = owner, fixed, 0

    def _is_own(self, node: ast.AST) -> bool:
        return isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == self._owner

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        if self._is_own(node) and node.attr in self._fixed and isinstance(node.ctx, ast.Load):
            return ast.Constant(self._fixed[node.attr])
        if node.attr in RESERVED:
            node.attr = PREFIX + node.attr
        return self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        own = self._is_own(node.left)
        self.generic_visit(node)
        if len(node.ops) == 1 and isinstance(node.ops[0], ast.Is | ast.IsNot):
            if isinstance(node.left, ast.Constant):
                return ast.Constant((node.left.value is None) == isinstance(node.ops[0], ast.Is))
            if own:
                return ast.Constant(isinstance(node.ops[0], ast.IsNot))
        return node

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.op, ast.Not) and isinstance(node.operand, ast.Constant):
            return ast.Constant(not node.operand.value)
        return node

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.AST:
        self.generic_visit(node)
        decides, values = isinstance(node.op, ast.Or), list[ast.expr]()
        for value in node.values:
            if not isinstance(value, ast.Constant):
                values.append(value)
            elif bool(value.value) == decides:
                values.append(value)
                break
        if not values:
            return ast.Constant(not decides)
        node.values = values
        return node if len(values) > 1 else values[0]

    def visit_If(self, node: ast.If) -> ast.AST | list[ast.AST]:
        node.test = self.visit(node.test)
        if isinstance(node.test, ast.Constant):
            kept = node.body if node.test.value else node.orelse
            return self._block(kept)
        node.body, node.orelse = self._block(node.body), self._block(node.orelse) if node.orelse else []
        return node

    def _block(self, statements: list[ast.stmt]) -> list[Any]:
        found: list[Any] = []
        for each in statements:
            made = self.visit(each)
            found += made if isinstance(made, list) else [made]
        return found or [ast.Pass()]

    def visit_IfExp(self, node: ast.IfExp) -> ast.AST:
        node.test = self.visit(node.test)
        if isinstance(node.test, ast.Constant):
            kept: ast.AST = self.visit(node.body if node.test.value else node.orelse)
            return kept
        return self.generic_visit(node)

    def visit_For(self, node: ast.For) -> ast.AST | list[ast.stmt]:
        self.generic_visit(node)
        if isinstance(node.iter, ast.Constant):  # nothing is in it
            return ast.Pass()
        if isinstance(node.iter, ast.Call):  # range
            return node
        self._loops += 1
        items, k = f"_items{self._loops}", f"_k{self._loops}"
        whole, loop = ast.parse(f"{items} = 0\nfor {k} in range(len({items})):\n    _ = {items}[{k}]").body
        assert isinstance(whole, ast.Assign)
        assert isinstance(loop, ast.For)
        assert isinstance(loop.body[0], ast.Assign)
        whole.value, loop.body[0].targets = node.iter, [node.target]
        loop.body += node.body
        return [whole, loop]
