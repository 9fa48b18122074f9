"""Model of a Zenoh router's `access_control`: enough to ask for the rights of an identity."""

from __future__ import annotations

from functools import cache
from typing import Any

import zenoh


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
    return any(
        flow in rule["flows"] and message in rule["messages"] and any(includes(each, key) for each in rule["key_exprs"])
        for rule in rules
    )


def may(control: dict[str, Any], common_name: str, action: str, key: str) -> bool:
    """Whether an action is possible: all the messages that it takes pass."""
    adv = f"{key}/@adv/pub/1/1/_"
    takes = {
        "put": [("ingress", "put", key)],
        "delete": [("ingress", "delete", key)],
        "keep": [
            ("ingress", "put", key),
            ("ingress", "put", adv),
            ("ingress", "declare_queryable", adv),
            ("ingress", "liveliness_token", adv),
            ("egress", "query", f"{key}/@adv/pub/**"),
            ("ingress", "reply", key),
        ],
        "hear": [("ingress", "declare_subscriber", key), ("egress", "put", key)],
        "last": [
            ("ingress", "declare_subscriber", f"{key}/@adv/pub/**"),
            ("ingress", "query", f"{key}/@adv/pub/**"),
            ("ingress", "declare_liveliness_subscriber", f"{key}/@adv/pub/**"),
            ("egress", "reply", key),
            ("egress", "liveliness_token", adv),
        ],
        "ask": [("ingress", "query", key), ("egress", "reply", key)],
        "answer": [("ingress", "declare_queryable", key), ("egress", "query", key), ("ingress", "reply", key)],
        "be": [("ingress", "liveliness_token", key)],
        "watch": [
            ("ingress", "liveliness_query", key),
            ("ingress", "declare_liveliness_subscriber", key),
            ("egress", "liveliness_token", key),
        ],
    }
    rules = held(control, common_name)
    return all(permitted(rules, *message) for message in takes[action])


ACTIONS = ("put", "delete", "keep", "hear", "last", "ask", "answer", "be", "watch")
