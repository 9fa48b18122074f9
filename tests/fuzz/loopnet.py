"""Former place of `tests.network`."""

from types import SimpleNamespace

from agents.network.pubsub import Orders
from tests.network import *  # noqa: F403
from tests.network import Reply, expression  # noqa: F401


def typed_orders(channel, kind):
    """Orders of a kind that arrive in a channel."""

    def declare(_key, handler, **_):
        channel.obey = handler
        return channel

    return Orders(SimpleNamespace(declare_queryable=declare), channel.key, kind)
