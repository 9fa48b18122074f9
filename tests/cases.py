"""Many small cases in one test, all of whose failures are told at once: a test of its own costs more than its check."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable


def for_each(names: str, cases: Iterable[object]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """As `pytest.mark.parametrize`; cases share the fixtures of one test."""
    keys, listed = names.replace(" ", "").split(","), list(cases)
    assert listed, "no case"

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        def every(**fixtures: object) -> None:
            failures = []
            for case in listed:
                values = case if len(keys) > 1 else (case,)
                try:
                    test(**dict(zip(keys, values, strict=True)), **fixtures)  # type: ignore[arg-type]
                except Exception as error:  # noqa: BLE001 (whatever a test raises)
                    error.add_note(f"case {case!r}")
                    failures.append(error)
            if failures:
                raise ExceptionGroup(f"{len(failures)} of {len(listed)} cases fail", failures)

        asked = inspect.signature(test).parameters.values()
        every.__signature__ = inspect.Signature([each for each in asked if each.name not in keys])  # type: ignore[attr-defined]
        every.__name__, every.__doc__, every.__module__ = test.__name__, test.__doc__, test.__module__
        every.__qualname__ = test.__qualname__
        return every

    return decorate
