"""Every Zenoh key expression of the project; no other module spells a key."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


class _RealmKey:
    """A key that a realm has once."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __get__(self, keys: Keys, owner: type[Keys]) -> str:
        return f"{keys.realm}/{self._path}"


def _robot_key(word: str) -> Callable[[Keys, str], str]:
    def key(keys: Keys, robot: str) -> str:
        return f"{keys.realm}/{robot}/{word}"

    return key


@dataclass(frozen=True)
class Keys:
    """Key expressions below one realm, so that several experiments can share a network."""

    realm: str = "park"

    # of each robot, by its name

    pose = _robot_key("pose")  # pose for the neighbours, sent when the trigger says so
    state = _robot_key("state")  # telemetry for recorder and viewers
    memory = _robot_key("memory")  # likewise, of laws that remember
    status = _robot_key("status")  # lifecycle and counters, at 1 Hz and on every change
    order = _robot_key("order")  # queryable that takes orders and always replies
    alive = _robot_key("alive")  # liveliness token
    position = _robot_key("position")  # pose measured from outside (motion capture, a twin service)
    goal = _robot_key("goal")  # goal given by the central controller, or from outside
    setpoint = _robot_key("setpoint")  # commands for a body that lives in another process
    ranges = _robot_key("ranges")  # readings of the range sensors
    truth = _robot_key("truth")  # true pose of a protocol twin: for recorder and motion capture, never for robots
    below = _robot_key("**")  # all keys of a robot, or of `world`, `run` or `centre`

    # of the world and the central controller; `state` and `alive` belong to robots only

    world = _RealmKey("world/report")  # pace, pauses and contacts of the world
    world_order = _RealmKey("world/order")  # queryable: pause, resume, reset
    contact = _RealmKey("world/contact")  # every contact in the world, when it begins
    world_event = _RealmKey("world/event")  # contacts, refused commands, and robots that the world lands
    world_alive = _RealmKey("world/here")  # liveliness token
    centre = _RealmKey("centre/report")  # guided robots, load, counters
    centre_alive = _RealmKey("centre/here")  # liveliness token

    # of the run

    estop = _RealmKey("estop")  # emergency stop for all robots
    event = _RealmKey("run/event")  # phases, losses, orders: the operator's, as all below `run`
    experiment = _RealmKey("run/experiment")  # case that runs, late joiners included
    conductor = _RealmKey("run/conductor")  # liveliness token
    run_order = _RealmKey("run/order")  # queryable: remove, restart, replace, add robots
    clock = _RealmKey("run/clock")  # clock offsets of other machines from the conductor's
    recorder = _RealmKey("run/recorder")  # liveliness token
    scene = _RealmKey("run/scene")  # drawing of the case for RViz, a MarkerArray as CDR, from the recorder
    everything = _RealmKey("**")  # all keys of the realm

    @staticmethod
    def lives(alive: str) -> str:
        """A liveliness key and all tokens below it: sessions and claims of its name."""
        return f"{alive}/**"

    @staticmethod
    def owner_tokens(alive: str) -> list[str]:
        """Keys of all tokens that the owner of a name may hold."""
        return [alive, Keys.life(alive, "*"), Keys.claim(alive, "*/*")]

    @staticmethod
    def life(alive: str, session: str) -> str:
        """Token of the session that owns the name of a liveliness key."""
        return f"{alive}/life/{session}"

    @staticmethod
    def rank(began: float, session: str) -> str:
        """Order of claims: the earlier start [s, UTC] first, then the smaller session."""
        return f"{round(began * 1e6):020d}/{session}"

    @staticmethod
    def claim(alive: str, rank: str) -> str:
        """Token of a claim to the name of a liveliness key."""
        return f"{alive}/claim/{rank}"

    @staticmethod
    def objection(alive: str, owner: str, session: str) -> str:
        """Token with which the session `owner` keeps its name against `session`; as a claim it is later than all."""
        return Keys.claim(alive, f"{session}/{owner}")

    @staticmethod
    def rank_of(alive: str, token: str) -> str | None:
        """The `rank` in the token of a claim; None for any other token."""
        begin = Keys.claim(alive, "")
        return token.removeprefix(begin) if token.startswith(begin) else None

    @staticmethod
    def life_of(token: str) -> str | None:
        """The session in the token of an owner; None for any other token."""
        before, _, session = token.rpartition("/")
        return session if before.endswith("/life") else None

    @staticmethod
    def session_of(token: str) -> str | None:
        """The session in the token of an owner or of a claim; None for any other token."""
        before, _, session = token.rpartition("/")
        return session if before.endswith("/life") or before.rpartition("/")[0].endswith("/claim") else None

    def robot_of(self, key: str) -> str | None:
        """The robot of `<realm>/<robot>/<what>`; None for any other key, as that of a PUT on many at once (`**`)."""
        realm, _, rest = key.partition("/")
        robot, _, what = rest.partition("/")
        return robot if realm == self.realm and robot and what else None
