"""Former place of `tests.network`."""

from tests.network import *  # noqa: F403
from tests.network import Orders, Reply, expression, typed_orders  # noqa: F401
