"""`python -m tests.fuzz`: see `tests.fuzz.nightly`, which is a module of its own because its processes import it."""

import sys

from tests.fuzz.nightly import main

sys.exit(main())
