"""`python -m tests.fuzz`: see `tests.fuzz.nightly`, which is a module of its own because its processes import it."""

import sys

from tests.fuzz.nightly import main

if __name__ == "__main__":
    sys.exit(main())
