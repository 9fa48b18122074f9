"""Access control of a lab: rights to publish, subscribe and query, and the rules of a Zenoh router that follow.

Zenoh checks kinds of messages, on their way in and out of the router. A verb here stands for all messages that one end
needs, the keys of advanced publishers included (`@adv`, which no wildcard of a rule matches by itself).
Everything else is denied. No rule denies: Zenoh compares whether the key of a rule *includes* that of the message. A
put on `park/**` would pass in spite of a rule that denies `park/*/order`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import reduce
from typing import Any, Final, Literal

import msgspec

from agents.network.lab import LabError, Register

Flow = Literal["ingress", "egress"]

MOST_BYTES: Final = 64 * 1024  # size of a message below the name of a robot, as readers accept
PASSED: Final = (
    "put", "query", "reply", "declare_subscriber", "declare_queryable",
    "liveliness_token", "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip


class Grant(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Rights of an identity: key expressions by verb."""

    publish: list[str] = []  # publish (PUT only: DELETE is never allowed)
    subscribe: list[str] = []  # subscribe, and ask for the last value that a publisher keeps
    answer: list[str] = []  # declare a queryable
    # receive queries on this wildcard, which others may send; a reply stays within `publish` and `answer`
    queried: list[str] = []
    query: list[str] = []  # query
    tokens: list[str] = []  # hold a liveliness token
    watch: list[str] = []  # subscribe to liveliness tokens

    def joined(self, other: Grant) -> Grant:
        """Union of the rights of two."""
        both = (sorted({*getattr(self, verb), *getattr(other, verb)}) for verb in self.__struct_fields__)
        return Grant(*both)


class Rights(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Rights in an experiment: of each robot by its name, of all others by their role."""

    realm: str  # first chunk of every key
    robots: dict[str, Grant]  # grants by name of a robot
    roles: dict[str, Grant]  # grants by role
    linked: bool = False  # routers forward to each other what they have let in; else a router may publish nothing

    def joined(self, other: Rights) -> Rights:
        """The rights of two experiments that share a router; raises LabError if their realms differ."""
        if self.realm != other.realm:
            raise LabError(
                f"cases in the realms {self.realm} and {other.realm} share no router: give them one network.realm"
            )
        robots, roles = _joined(self.robots, other.robots), _joined(self.roles, other.roles)
        return Rights(self.realm, robots, roles, self.linked or other.linked)


def _joined(one: Mapping[str, Grant], other: Mapping[str, Grant]) -> dict[str, Grant]:
    return {name: one.get(name, Grant()).joined(other.get(name, Grant())) for name in {**one, **other}}


def _messages(grant: Grant, realm: str) -> Iterator[tuple[Flow, tuple[str, ...], list[str]]]:
    """Flow, kinds of messages and keys of each allowance."""
    kept, wanted = _cache_keys(grant.publish), _cache_keys(grant.subscribe)
    yield "ingress", ("put", "reply"), [*grant.publish, *kept]
    yield "ingress", ("declare_queryable", "liveliness_token"), kept
    yield "egress", ("query",), kept
    yield "ingress", ("declare_subscriber",), [*grant.subscribe, *wanted]
    yield "ingress", ("query", "liveliness_query", "declare_liveliness_subscriber"), wanted
    yield "egress", ("put", "reply"), [*grant.subscribe, *wanted]
    yield "egress", ("liveliness_token",), wanted
    yield "ingress", ("declare_queryable", "reply"), grant.answer
    yield "egress", ("query",), [*grant.answer, *grant.queried]
    yield "ingress", ("query",), grant.query
    yield "egress", ("reply",), grant.query
    yield "ingress", ("liveliness_token",), grant.tokens
    yield "ingress", ("liveliness_query", "declare_liveliness_subscriber"), grant.watch
    yield "egress", ("liveliness_token",), grant.watch
    # a publisher that knows of no subscriber sends nothing: all learn the subscriptions, not the values
    everything = [f"{realm}/**", *_cache_keys([f"{realm}/**"]), *grant.publish, *kept, *grant.query]
    yield "egress", ("declare_subscriber", "declare_queryable"), everything


def _cache_keys(keys: Iterable[str]) -> list[str]:
    """Keys of the caches and of the detection of advanced publishers."""
    return [f"{key}/@adv/**" for key in keys if not key.startswith("@")]


def rules(rights: Rights, register: Register) -> dict[str, Any]:
    """The `access_control` of a router: default deny, one subject for each valid certificate.

    Robots that are not in the register get no rights. Raises LabError if another role has the name of a robot.
    """
    made: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for name, identity in register.identities.items():
        if identity.role == "robot":
            grant = rights.robots.get(name)
        else:
            grant = rights.roles.get(identity.role)
            if name in rights.robots:
                raise LabError(
                    f"'{name}' is a robot of the experiment and {identity.role} of the lab: rename the robot"
                )
        if identity.role == "router" and rights.linked:
            own = list(_passed(name, rights))
        elif grant is None:
            continue
        else:
            own = list(_rules(name, grant, rights.realm))
        made += own
        subjects.append({"id": name, "cert_common_names": [identity.common_name]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    return {"enabled": True, "default_permission": "deny", "rules": made, "subjects": subjects, "policies": policies}


def _rules(name: str, grant: Grant, realm: str) -> Iterator[dict[str, Any]]:
    """The rules of one identity."""
    for number, (flow, kinds, keys) in enumerate(_messages(grant, realm)):
        if keys:
            yield {
                "id": f"{name}-{number}",
                "permission": "allow",
                "flows": [flow],
                "messages": list(kinds),
                "key_exprs": list(dict.fromkeys(keys)),
            }


def _passed(name: str, rights: Rights) -> Iterator[dict[str, Any]]:
    """The rules of a router that is linked with another: messages that either has let in pass, on keys of any right."""
    union = reduce(Grant.joined, (*rights.robots.values(), *rights.roles.values()), Grant())
    granted = {key for verb in Grant.__struct_fields__ for key in getattr(union, verb)}
    foreign = sorted(key for key in granted if not key.startswith(f"{rights.realm}/"))
    keys = [f"{rights.realm}/**", *foreign]
    yield {
        "id": f"{name}-linked",
        "permission": "allow",
        "flows": ["ingress", "egress"],
        "messages": list(PASSED),
        "key_exprs": [*keys, *_cache_keys(keys)],
    }


def sizes(rights: Rights) -> list[dict[str, Any]]:
    """The `low_pass_filter` of a router: below the name of a robot no message is larger than readers accept."""
    named: Sequence[str] = [f"{rights.realm}/*/{part}" for part in ("**", "**/@adv/**")]
    # `run` holds the experiment, which grows with its robots
    below = [key.replace("*", name, 1) for name in (*rights.robots, "world", "centre") for key in named]
    return [
        {
            "id": "sizes",
            "flows": ["ingress"],
            "messages": ["put", "query", "reply"],
            "key_exprs": [f"{rights.realm}/estop", *below],
            "size_limit": MOST_BYTES,
        }
    ]
