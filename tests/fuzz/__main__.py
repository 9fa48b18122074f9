"""`python -m tests.fuzz`: see `tests.fuzz.fuzz`, which is a module of its own because its processes import it."""

import sys

from tests.fuzz.fuzz import main

sys.exit(main())
