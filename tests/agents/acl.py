"""Model of a Zenoh router's `access_control`: enough to ask for the rights of an identity."""

from functools import cache
from typing import Any

import zenoh

TAKES = {  # messages that an action takes: the flow, the kind, and whether on its key, its cache or its history
    "put": "ingress put key",
    "delete": "ingress delete key",
    "keep": "ingress put key, ingress put cache, ingress declare_queryable cache, ingress liveliness_token cache, "
    "egress query history, ingress reply key",
    "hear": "ingress declare_subscriber key, egress put key",
    "last": "ingress declare_subscriber history, ingress query history, "
    "ingress declare_liveliness_subscriber history, egress reply key, egress liveliness_token cache",
    "ask": "ingress query key, egress reply key",
    "answer": "ingress declare_queryable key, egress query key, ingress reply key",
    "be": "ingress liveliness_token key",
    "watch": "ingress liveliness_query key, ingress declare_liveliness_subscriber key, egress liveliness_token key",
}
ACTIONS = tuple(TAKES)


@cache
def includes(each: str, key: str) -> bool:
    """Whether a key expression has all keys of another; asked for the same ones thousands of times."""
    return zenoh.KeyExpr(each).includes(key)


def held(control: dict[str, Any], common_name: str) -> list[dict[str, Any]]:
    """The rules of all policies of somebody."""
    assert control["enabled"]
    assert control["default_permission"] == "deny"
    assert all(rule["permission"] == "allow" for rule in control["rules"])
    mine = {each["id"] for each in control["subjects"] if common_name in each["cert_common_names"]}
    names = {rule for policy in control["policies"] if mine & set(policy["subjects"]) for rule in policy["rules"]}
    return [rule for rule in control["rules"] if rule["id"] in names]


def permitted(rules: list[dict[str, Any]], flow: str, message: str, key: str) -> bool:
    """Whether a message passes: one of the sender's rules includes its key."""
    fitting = [rule for rule in rules if flow in rule["flows"] and message in rule["messages"]]
    return any(includes(each, key) for rule in fitting for each in rule["key_exprs"])


def may(control: dict[str, Any], common_name: str, action: str, key: str) -> bool:
    """Whether an action is possible: all the messages that it takes pass."""
    rules, keys = held(control, common_name), {"key": key, "cache": f"{key}/@adv/pub/1/1/_"}
    keys["history"] = f"{key}/@adv/pub/**"
    messages = [text.split() for text in TAKES[action].split(", ")]
    return all(permitted(rules, flow, message, keys[where]) for flow, message, where in messages)
