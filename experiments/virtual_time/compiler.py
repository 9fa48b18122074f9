"""Compilation of quiet functions over records; the only module that knows numba.

`LayoutType` is what numba sees of an object: an address, and the layout of the record that stands there.
"""

from __future__ import annotations

import ctypes
import enum
import inspect
import math
import operator
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from llvmlite import binding, ir
from numba import config, njit, types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.errors import NumbaError
from numba.core.imputils import lower_builtin, lower_getattr_generic, lower_setattr_generic
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, infer_getattr, infer_global, signature
from numba.extending import intrinsic, register_model

from experiments.virtual_time.records import BOOL, FLOAT, INT, WORD, Floats, Items, RecordLayout, width
from experiments.virtual_time.source import BUILTINS, POWER, PREFIX, SAFE, STRICT, is_foreign, place, specialised

config.LOOP_VECTORIZE = 0  # a tenth of the time of compilation, and of no use here
config.USING_SVML = False  # functions of the C library, as Python has them
LIBRARY_POWER: Final = "zenpark_pow"  # `pow` of the C library under a name of which a compiler knows nothing
binding.add_symbol(LIBRARY_POWER, ctypes.cast(ctypes.CDLL(None).pow, ctypes.c_void_p).value)
NUMBER = ir.IntType(64)
SIMPLE = {FLOAT: types.float64, INT: types.int64, BOOL: types.boolean}
CONSTANTS = {float: types.float64, int: types.int64, bool: types.boolean}  # of a class


class LayoutType(types.Type):  # type: ignore[misc]
    """Object of a layout."""

    def __init__(self, layout: RecordLayout) -> None:
        self.layout = layout
        super().__init__(name=f"{layout.name}.{id(layout)}")  # layouts are kept for ever


class Several(types.Type):  # type: ignore[misc]
    """List of values of a kind."""

    def __init__(self, kind: Any) -> None:
        self.kind, self.type = kind, type_of(kind)
        super().__init__(name=f"Several({self.type})")


@cache
def type_of(kind: Any) -> Any:
    """numba's type of a kind of value."""
    if isinstance(kind, Floats):
        return types.UniTuple(types.float64, kind.size)
    if isinstance(kind, Items):
        return Several(kind.item)
    return LayoutType(kind) if isinstance(kind, RecordLayout) else SIMPLE[kind]


@register_model(LayoutType)
class _LayoutModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, NUMBER)


@register_model(Several)
class _SeveralModel(models.StructModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, [("address", types.int64), ("count", types.int64)])


def _place(builder: Any, address: Any, word: int, of: Any = NUMBER) -> Any:
    return builder.inttoptr(builder.add(address, ir.Constant(NUMBER, WORD * word)), of.as_pointer())


def _load(context: Any, builder: Any, kind: Any, address: Any, word: int) -> Any:
    """Value of a kind that stands some words behind an address."""
    if kind == FLOAT:
        return builder.load(_place(builder, address, word, ir.DoubleType()))
    if isinstance(kind, Floats):
        values = [_load(context, builder, FLOAT, address, word + k) for k in range(kind.size)]
        return context.make_tuple(builder, type_of(kind), values)
    whole = builder.load(_place(builder, address, word))
    if kind == BOOL:
        return builder.trunc(whole, ir.IntType(1))
    if isinstance(kind, Items):
        return _several(context, builder, type_of(kind), whole, builder.load(_place(builder, address, word + 1)))
    return whole


def _several(context: Any, builder: Any, kind: Any, address: Any, count: Any) -> Any:
    made = cgutils.create_struct_proxy(kind)(context, builder)
    made.address, made.count = address, count
    return made._getvalue()


def _store(builder: Any, kind: Any, address: Any, word: int, value: Any) -> None:
    if kind == FLOAT:
        builder.store(value, _place(builder, address, word, ir.DoubleType()))
    elif isinstance(kind, Floats):
        for k in range(kind.size):
            _store(builder, FLOAT, address, word + k, builder.extract_value(value, k))
    else:
        builder.store(builder.zext(value, NUMBER) if kind == BOOL else value, _place(builder, address, word))


@cache
def method(layout: RecordLayout, name: str) -> Any:
    """Compiled method of objects of a layout; None if there is none."""
    found = getattr(layout.owner, name, None)
    return compiled(found, layout) if inspect.isfunction(found) else None


@cache
def compiled(function: Callable[..., Any], layout: RecordLayout | None = None) -> Any:
    """Function, compiled; a method for objects of a layout. Raises SyntaxError outside of the subset."""
    code, names = specialised(function, {} if layout is None else layout.fixed)
    space: dict[str, Any] = {"__name__": function.__module__}
    exec(code, space)
    made = _njit(space[function.__name__])
    for name in names - {function.__name__, *space[function.__name__].__code__.co_varnames}:
        value = function.__globals__.get(name)
        if is_foreign(function):
            value = _strict(function, name, value)
        elif inspect.isfunction(value):
            value = compiled(value)
        if value is not None:
            space[name] = value
    return made


def kept(function: Callable[..., Any], kinds: Sequence[str], folder: Path) -> Any:
    """Function of values of these kinds, compiled and kept in a folder; raises TypeError where it cannot be."""
    config.CACHE_DIR = str(folder)
    made = njit(function, cache=True, nogil=True)
    try:
        made.compile(tuple(SIMPLE[kind] for kind in kinds))
    except NumbaError as error:
        raise TypeError(str(error)) from error
    return made


def _njit(function: Callable[..., Any]) -> Any:
    return njit(function, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)  # called by compiled ones alone


def _strict(function: Callable[..., Any], name: str, value: Any) -> Any:
    """Object behind a name in a function of others, None for one that the compiler knows; raises SyntaxError."""
    if name == POWER:
        return _njit(_power)
    if value is None and name in BUILTINS:
        return compiled(STRICT[name]) if name in STRICT else None
    if inspect.isfunction(value):
        return compiled(value)
    if value is math:
        return _strict_math()
    if inspect.isbuiltin(value) and value.__module__ == math.__name__:
        value = getattr(_strict_math(), value.__name__, None)
    elif not (isinstance(value, bool | int | float | enum.EnumMeta) or _is_numbers(value)):
        value = None
    if value is None:
        raise SyntaxError(f"{place(function)}: {function.__qualname__} uses {name}, which may not be the same compiled")
    return value


def _is_numbers(value: Any) -> bool:
    return isinstance(value, tuple) and all(isinstance(each, int | float) or _is_numbers(each) for each in value)


@cache
def _strict_math() -> ModuleType:
    """Functions and constants of `math` for plug-ins of others."""
    made = ModuleType("strict_math")
    for name, function in STRICT.items():
        setattr(made, name, compiled(function))
    for name in SAFE:
        setattr(made, name, getattr(math, name))
    return made


_library_power = types.ExternalFunction(LIBRARY_POWER, signature(types.float64, types.float64, types.float64))


def _power(x: float, y: float) -> float:
    """x ** y; of whole numbers it is one with a fraction of 0."""
    x, y = float(x), float(y)
    if (x < 0.0 and math.floor(y) != y) or (x == 0.0 and y < 0.0):
        raise ValueError("no power, or a complex one")
    found: float = _library_power(x, y)
    if abs(found) == math.inf and abs(x) < math.inf and abs(y) < math.inf:
        raise OverflowError("result too large")
    return found


@infer_getattr
class _Attributes(AttributeTemplate):  # type: ignore[misc]
    key = LayoutType

    def generic_resolve(self, thing: Any, name: str) -> Any:
        layout, name = thing.layout, name.removeprefix(PREFIX)
        if name in layout.fields:
            return type_of(layout.fields[name])
        if (found := method(layout, name)) is None:
            return CONSTANTS.get(type(getattr(layout.owner, name, None)))
        _lower_method(name)
        of_method = types.Dispatcher(found)

        class Method(AbstractTemplate):  # type: ignore[misc]
            key = (LayoutType, name)

            def generic(self, args: Any, kws: Any) -> Any:
                return of_method.get_call_type(self.context, (thing, *args), kws).as_method()

        return types.BoundFunction(Method, thing)


@cache
def _lower_method(name: str) -> None:
    @lower_builtin((LayoutType, name), LayoutType, types.VarArg(types.Any))  # type: ignore[untyped-decorator]
    def call(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        function = context.get_function(types.Dispatcher(method(sig.args[0].layout, name)), sig)
        context.add_linking_libs(getattr(function, "libs", ()))
        return function(builder, args)


@lower_getattr_generic(LayoutType)  # type: ignore[untyped-decorator]
def _get(context: Any, builder: Any, kind: Any, value: Any, name: str) -> Any:
    layout, name = kind.layout, name.removeprefix(PREFIX)
    if name not in layout.fields:
        found = getattr(layout.owner, name)
        return value if callable(found) else context.get_constant(CONSTANTS[type(found)], found)
    return _load(context, builder, layout.fields[name], value, layout.offset[name])


@lower_setattr_generic(LayoutType)  # type: ignore[untyped-decorator]
def _set(context: Any, builder: Any, sig: Any, args: Any, name: str) -> None:
    layout, name = sig.args[0].layout, name.removeprefix(PREFIX)
    kind = layout.fields[name]
    _store(builder, kind, args[0], layout.offset[name], context.cast(builder, args[1], sig.args[1], type_of(kind)))


@infer_global(operator.getitem)
class _GetItem(AbstractTemplate):  # type: ignore[misc]
    def generic(self, args: Any, kws: Any) -> Any:
        if isinstance(args[0], Several) and isinstance(args[1], types.Integer):
            return signature(args[0].type, args[0], types.int64)
        return None


@infer_global(operator.setitem)
class _SetItem(AbstractTemplate):  # type: ignore[misc]
    def generic(self, args: Any, kws: Any) -> Any:
        if isinstance(args[0], Several) and isinstance(args[1], types.Integer):
            return signature(types.void, args[0], types.int64, args[0].type)
        return None


@infer_global(len)
class _Len(AbstractTemplate):  # type: ignore[misc]
    def generic(self, args: Any, kws: Any) -> Any:
        return signature(types.int64, args[0]) if isinstance(args[0], Several) else None


def _item(context: Any, builder: Any, kind: Any, several: Any, index: Any) -> Any:
    """Address of an item; IndexError as Python has it."""
    count = builder.extract_value(several, 1)
    behind = builder.icmp_signed("<", index, ir.Constant(NUMBER, 0))
    index = builder.select(behind, builder.add(index, count), index)
    with builder.if_then(builder.icmp_unsigned(">=", index, count), likely=False):
        context.call_conv.return_user_exc(builder, IndexError, ("list index out of range",))
    step = builder.mul(index, ir.Constant(NUMBER, WORD * width(kind)))
    return builder.add(builder.extract_value(several, 0), step)


@lower_builtin(operator.getitem, Several, types.int64)  # type: ignore[untyped-decorator]
def _get_item(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind = sig.args[0].kind
    return _load(context, builder, kind, _item(context, builder, kind, *args), 0)


@lower_builtin(operator.setitem, Several, types.int64, types.Any)  # type: ignore[untyped-decorator]
def _set_item(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind = sig.args[0].kind
    _store(builder, kind, _item(context, builder, kind, *args[:2]), 0, args[2])
    return context.get_dummy_value()


@lower_builtin(len, Several)  # type: ignore[untyped-decorator]
def _len(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.extract_value(args[0], 1)


def opened(kind: Any) -> Any:
    """Compiled function that gives the object, or the list of `count` values, at an address."""
    of = type_of(kind)

    @intrinsic  # type: ignore[untyped-decorator]
    def found(typing_context: Any, address: Any, count: Any) -> Any:
        def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return args[0] if isinstance(of, LayoutType) else _several(context, builder, of, *args)

        return of(types.int64, types.int64), code

    return found
