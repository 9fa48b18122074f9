"""Source of quiet functions, as a compiler gets it: for objects of which some attributes are constants.

`x.y is None` is decided, what that rules out is left out, and loops over lists count.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable, Mapping
from types import CodeType
from typing import Any, Final

RESERVED: Final = {"view"}  # attributes that mean something else to the compiler
PREFIX: Final = "its_"  # in front of those


def specialised(function: Callable[..., Any], fixed: Mapping[str, Any]) -> tuple[CodeType, set[str]]:
    """Code of a module that defines the function, and the names that it uses.

    `fixed`: constant attributes of its first argument, with their values. Raises SyntaxError or OSError for a function
    without source of its own.
    """
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    definition = tree.body[0]
    if not isinstance(definition, ast.FunctionDef):
        raise SyntaxError(f"{function.__qualname__} is no plain function")
    arguments = definition.args
    definition.decorator_list, definition.returns = [], None
    for each in (*arguments.args, *arguments.kwonlyargs):
        each.annotation = None
    owner = arguments.args[0].arg if arguments.args else ""
    tree = ast.fix_missing_locations(Specialised(owner, fixed).visit(tree))
    ast.increment_lineno(tree, function.__code__.co_firstlineno - 1)
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    return compile(tree, function.__code__.co_filename, "exec"), names


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
