"""Who may say, hear, ask and answer what: from rights in these words to the access control of a Zenoh router.

Zenoh checks kinds of messages, on their way in and out of the router. A verb here stands for all that one end of a
conversation needs, the keys of advanced publishers included (`@adv`, which no wildcard of a rule matches by itself).
Everything else is denied. There are no rules that deny: Zenoh asks whether the key of a rule *includes* that of the
message, so that a put on `park/**` would slip through beside a rule that denies `park/*/order`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import reduce
from typing import Any, Final, Literal

import msgspec

from agents.network.lab import LabError, Register

Flow = Literal["ingress", "egress"]

MOST_BYTES: Final = 64 * 1024  # of a message below a robot's name; what readers refuse need not travel
ADMIN: Final = "@/**"  # Zenoh's own keys: who is connected to a router
OWN_ADMIN: Final = "@/*/client/**"
PASSED: Final = (
    "put", "query", "reply", "declare_subscriber", "declare_queryable",
    "liveliness_token", "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip


class Grant(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """What somebody may do: key expressions by verb.

    Attributes:
        say: Publish. To delete is no one's right.
        hear: Subscribe, and ask for the last value that a publisher keeps.
        answer: Be asked.
        reached: Be reached by a query on this wildcard, which others have the right to ask; an answer to it stays
            within `say` and `answer`.
        ask: Query.
        be: Hold a liveliness token.
        watch: See liveliness tokens.
    """

    say: list[str] = []
    hear: list[str] = []
    answer: list[str] = []
    reached: list[str] = []
    ask: list[str] = []
    be: list[str] = []
    watch: list[str] = []

    def joined(self, other: Grant) -> Grant:
        """What either of two may do."""
        both = (sorted({*getattr(self, verb), *getattr(other, verb)}) for verb in self.__struct_fields__)
        return Grant(*both)


class Rights(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Who may do what in an experiment: each robot by its name, everybody else by its role.

    Attributes:
        realm: First chunk of every key.
        robots: By name.
        roles: By role.
        linked: Whether routers pass on to each other what they have let in; else a router may say nothing.
    """

    realm: str
    robots: dict[str, Grant]
    roles: dict[str, Grant]
    linked: bool = False

    def joined(self, other: Rights) -> Rights:
        """The rights of two experiments that share a router.

        Raises:
            LabError: If their realms differ.
        """
        if self.realm != other.realm:
            raise LabError(
                f"cases in the realms {self.realm} and {other.realm} share no router: give them one network.realm"
            )
        robots, roles = _joined(self.robots, other.robots), _joined(self.roles, other.roles)
        return Rights(self.realm, robots, roles, self.linked or other.linked)


def _joined(one: Mapping[str, Grant], other: Mapping[str, Grant]) -> dict[str, Grant]:
    return {name: one.get(name, Grant()).joined(other.get(name, Grant())) for name in {**one, **other}}


def _messages(grant: Grant, realm: str) -> Iterator[tuple[Flow, tuple[str, ...], list[str]]]:
    """Which messages, which way, on which keys."""
    said, heard = _kept(grant.say), _kept(grant.hear)
    yield "ingress", ("put", "reply"), [*grant.say, *said]
    yield "ingress", ("declare_queryable", "liveliness_token"), said
    yield "egress", ("query",), said
    yield "ingress", ("declare_subscriber",), [*grant.hear, *heard]
    yield "ingress", ("query", "liveliness_query", "declare_liveliness_subscriber"), heard
    yield "egress", ("put", "reply"), [*grant.hear, *heard]
    yield "egress", ("liveliness_token",), heard
    yield "ingress", ("declare_queryable", "reply"), grant.answer
    yield "egress", ("query",), [*grant.answer, *grant.reached]
    yield "ingress", ("query",), grant.ask
    yield "egress", ("reply",), grant.ask
    yield "ingress", ("liveliness_token",), grant.be
    yield "ingress", ("liveliness_query", "declare_liveliness_subscriber"), grant.watch
    yield "egress", ("liveliness_token",), grant.watch
    # a publisher that knows of no subscriber sends nothing: everybody learns who listens to what, not what is said
    everything = [f"{realm}/**", *_kept([f"{realm}/**"]), *grant.say, *said, *grant.ask]
    yield "egress", ("declare_subscriber", "declare_queryable"), everything
    yield "ingress", ("declare_queryable", "reply"), [OWN_ADMIN]
    yield "egress", ("query",), [ADMIN]


def _kept(keys: Iterable[str]) -> list[str]:
    """Where advanced publishers on these keys keep their last values, and say that they are there."""
    return [f"{key}/@adv/**" for key in keys if not key.startswith("@")]


def rules(rights: Rights, register: Register) -> dict[str, Any]:
    """The `access_control` of a router: default deny, a subject for everybody who has a certificate that counts.

    Args:
        rights: Of the experiment.
        register: Of the lab; robots that are not in it get no rights.

    Raises:
        LabError: If the certificate on a robot's name is somebody else's.
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
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": made,
        "subjects": subjects,
        "policies": policies,
    }


def _rules(name: str, grant: Grant, realm: str) -> Iterator[dict[str, Any]]:
    """The rules of one identity; kinds of messages on the same keys in one."""
    keys: dict[tuple[Flow, str], set[str]] = {}
    for flow, kinds, on in _messages(grant, realm):
        for kind in kinds:
            keys.setdefault((flow, kind), set()).update(on)
    together: dict[tuple[Flow, tuple[str, ...]], list[str]] = {}
    for (flow, kind), several in keys.items():
        if several:
            together.setdefault((flow, tuple(sorted(several))), []).append(kind)
    for number, ((flow, same), messages) in enumerate(together.items()):
        yield {
            "id": f"{name}-{number}",
            "permission": "allow",
            "flows": [flow],
            "messages": messages,
            "key_exprs": list(same),
        }


def _passed(name: str, rights: Rights) -> Iterator[dict[str, Any]]:
    """The rules of a router that is linked with another: what either has let in passes, on keys of somebody's right."""
    anybody = reduce(Grant.joined, (*rights.robots.values(), *rights.roles.values()), Grant())
    granted = {key for verb in Grant.__struct_fields__ for key in getattr(anybody, verb)}
    foreign = sorted(key for key in granted if not key.startswith((f"{rights.realm}/", "@/**")))
    keys = [f"{rights.realm}/**", *foreign]
    yield {
        "id": f"{name}-linked",
        "permission": "allow",
        "flows": ["ingress", "egress"],
        "messages": list(PASSED),
        "key_exprs": [*keys, *_kept(keys), ADMIN],
    }


def sizes(rights: Rights) -> list[dict[str, Any]]:
    """The `low_pass_filter` of a router: below a robot's name nothing is larger than what readers take."""
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
