"""Every Zenoh key expression of the project; no other module spells a key."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Keys:
    """Key expressions below one realm, so that several experiments can share a network."""

    realm: str = "park"

    def pose(self, robot: str) -> str:
        """Pose for the neighbours, sent when the trigger says so."""
        return f"{self.realm}/{robot}/pose"

    def state(self, robot: str) -> str:
        """Telemetry for recorder and viewers."""
        return f"{self.realm}/{robot}/state"

    def status(self, robot: str) -> str:
        """Lifecycle and counters, at 1 Hz and on every change."""
        return f"{self.realm}/{robot}/status"

    def order(self, robot: str) -> str:
        """Queryable that takes orders and always replies."""
        return f"{self.realm}/{robot}/order"

    def alive(self, robot: str) -> str:
        """Liveliness token."""
        return f"{self.realm}/{robot}/alive"

    @staticmethod
    def lives(alive: str) -> str:
        """A liveliness key and all tokens below it: sessions and claims of its name."""
        return f"{alive}/**"

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
    def rank_of(alive: str, token: str) -> str | None:
        """The `rank` in the token of a claim; None for any other token."""
        begin = Keys.claim(alive, "")
        return token.removeprefix(begin) if token.startswith(begin) else None

    @staticmethod
    def life_of(token: str) -> str | None:
        """The session in the token of an owner; None for any other token."""
        before, _, session = token.rpartition("/")
        return session if before.endswith("/life") else None

    def position(self, robot: str) -> str:
        """Pose of this robot, measured from outside (motion capture, a twin service)."""
        return f"{self.realm}/{robot}/position"

    def goal(self, robot: str) -> str:
        """Goal from the central controller, or from outside."""
        return f"{self.realm}/{robot}/goal"

    def setpoint(self, robot: str) -> str:
        """Commands for a body that lives in another process."""
        return f"{self.realm}/{robot}/setpoint"

    def ranges(self, robot: str) -> str:
        """Readings of the range sensors."""
        return f"{self.realm}/{robot}/ranges"

    def truth(self, robot: str) -> str:
        """True pose of a protocol twin: for recorder and simulated motion capture, never for robots."""
        return f"{self.realm}/{robot}/truth"

    @property
    def world(self) -> str:
        """Report of the world: pace, pauses, contacts. Not `state`, which only robots have."""
        return f"{self.realm}/world/report"

    @property
    def world_order(self) -> str:
        """Queryable of the world: pause, step, reset, spawn, remove."""
        return f"{self.realm}/world/order"

    @property
    def contact(self) -> str:
        """Every contact in the world, when it begins."""
        return f"{self.realm}/world/contact"

    @property
    def world_alive(self) -> str:
        """Liveliness token of the world. Not `alive`, which is counted as a robot."""
        return f"{self.realm}/world/here"

    @property
    def centre(self) -> str:
        """Report of the central controller: guided robots, load, counters. Not `state`, which only robots have."""
        return f"{self.realm}/centre/report"

    @property
    def centre_alive(self) -> str:
        """Liveliness token of the central controller. Not `alive`, as that of the world."""
        return f"{self.realm}/centre/here"

    @property
    def estop(self) -> str:
        """Emergency stop for all robots."""
        return f"{self.realm}/estop"

    @property
    def event(self) -> str:
        """Events of the run: phases, losses, orders."""
        return f"{self.realm}/run/event"

    @property
    def experiment(self) -> str:
        """The experiment as it runs, late joiners included."""
        return f"{self.realm}/run/experiment"

    @property
    def conductor(self) -> str:
        """Liveliness token of the conductor."""
        return f"{self.realm}/run/conductor"

    @property
    def run_order(self) -> str:
        """Queryable of the conductor: pause, resume, remove, restart, replace, add robots of a run under way."""
        return f"{self.realm}/run/order"

    @property
    def clock(self) -> str:
        """Clock offsets of other machines from the conductor's."""
        return f"{self.realm}/run/clock"

    @property
    def recorder(self) -> str:
        """Liveliness token of the recorder."""
        return f"{self.realm}/run/recorder"

    def below(self, name: str) -> str:
        """All keys of a robot, or of `world`, `run` or `centre`."""
        return f"{self.realm}/{name}/**"

    @property
    def everything(self) -> str:
        """All keys of the realm."""
        return f"{self.realm}/**"

    def robot(self, key: str) -> str:
        """The robot that a key of this realm belongs to.

        Raises:
            ValueError: If the key is not `<realm>/<robot>/<what>`.
        """
        realm, _, rest = key.partition("/")
        robot, _, what = rest.partition("/")
        if realm != self.realm or not robot or not what:
            raise ValueError(f"'{key}' is not a key of a robot in '{self.realm}'")
        return robot

    def whose(self, key: str) -> str | None:
        """The robot that a key belongs to; None if there is none, as for a PUT on many keys at once (`**`)."""
        try:
            return self.robot(key)
        except ValueError:
            return None
