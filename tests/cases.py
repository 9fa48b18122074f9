"""Tables of cases: in one test, whose failures are all told at once, or as tests of which --quick runs some."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable

import pytest
from hypothesis import settings


def examples(count: int) -> settings:
    """Settings of a test with this many random examples in `./zenpark test --all`; else a third, with --quick five."""
    profile = settings.get_current_profile_name()
    return (
        settings() if profile == "quick" else settings(max_examples=count if profile == "all" else max(10, count // 3))
    )


def mostly_slow(cases: Iterable[object], every: int) -> list[object]:
    """Parameters of `pytest.mark.parametrize`: --quick runs the first one, and of those behind it one in `every`."""
    return [
        case if k % every == 0 else pytest.param(*(case if isinstance(case, tuple) else [case]), marks=pytest.mark.slow)
        for k, case in enumerate(cases)
    ]


def nightly(*values: object) -> object:
    """A row of `pytest.mark.parametrize` that runs with --all alone."""
    return pytest.param(*values, marks=pytest.mark.nightly)


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
