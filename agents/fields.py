"""Fields of structs by their names in files and on command lines: where every walk over structs begins."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, get_args, get_origin

import msgspec


@cache
def fields_of(struct: type[msgspec.Struct]) -> Mapping[str, msgspec.structs.FieldInfo]:
    """Fields by their encoded names. Cached: resolving annotations takes longer than checking a table."""
    return {field.encode_name: field for field in msgspec.structs.fields(struct)}


def default_of(field: msgspec.structs.FieldInfo) -> Any:  # noqa: ANN401 - any value of a file
    return field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()


def bare(annotation: object) -> tuple[Any, msgspec.Meta]:
    """An annotation without its constraints, and of these the last with a description, else the last."""
    if get_origin(annotation) is not Annotated:
        return annotation, msgspec.Meta()
    plain, *metas = get_args(annotation)
    known = [each for each in metas if isinstance(each, msgspec.Meta)]
    return plain, next((each for each in reversed(known) if each.description), (known or [msgspec.Meta()])[-1])


def description(struct: type[msgspec.Struct], name: str) -> str:
    """Text of a field; empty without one, and for a name that is no field."""
    field = fields_of(struct).get(name)
    return "" if field is None else bare(field.type)[1].description or ""


def structs_in(plain: object) -> list[type[msgspec.Struct]]:
    """A struct, or those of a union."""
    return [each for each in (plain, *get_args(plain)) if isinstance(each, type) and issubclass(each, msgspec.Struct)]
