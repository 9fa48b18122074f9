"""Base of the errors that a user can mend: a command prints them without a traceback and ends with exit code 2."""


class ExplainedError(Exception):
    """An error with a text that names the place and the remedy."""


class Refusal(Exception):
    """An order that is not carried out, with reason and remedy."""
