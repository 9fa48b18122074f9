"""JSON that stands on the command line: read, and what is wrong with it in words."""

from __future__ import annotations

from typing import Any, Final

import msgspec

from experiments.locate import Path
from experiments.problem import DocumentError, Problem
from experiments.shape import faults

OBJECT: Final = "write an object, '{\"name\": value}'"


def table(flag: str, text: str, struct: type[msgspec.Struct] | None = None, path: Path = ()) -> dict[str, Any]:
    """The object that stands behind a flag.

    Args:
        flag: Such as "--obstacle".
        text: What stands behind it.
        struct: What it must be; None: any object.
        path: Where it would stand in an experiment file, if it could.

    Raises:
        DocumentError: If it is no JSON, no object, or not what it must be.
    """
    place = f"{flag} {text}"
    try:
        value = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        why = str(error).removeprefix("JSON is malformed: ")
        raise DocumentError([Problem(place, 0, 0, f"is not JSON: {why}", OBJECT)]) from None
    if not isinstance(value, dict):
        raise DocumentError([Problem(place, 0, 0, "is no JSON object", OBJECT)])
    found = [] if struct is None else faults(value, struct, path)
    if found:
        raise DocumentError([Problem(place, 0, 0, fault.message, fault.hint) for fault in found])
    return value
