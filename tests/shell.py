"""Former place of `tests.commands`."""

from tests.commands import shell  # noqa: F401
