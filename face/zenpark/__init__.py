"""Names for notebooks and plug-ins: `from zenpark import load, simulate` (docs/python.md).

The launcher of the checkout is a file of this name, so the package stands in a folder of its own. An editable
installation copies it, which is why its contents are elsewhere, in `experiments.api`.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from experiments.api import *  # noqa: F403
else:
    from experiments.api import __all__, __dir__, __getattr__  # noqa: F401
