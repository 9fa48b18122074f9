"""Result structs: metrics of one case, per robot, per link and for the formation."""

from __future__ import annotations

from typing import Literal

import msgspec

from experiments.definition.experiment import Criterion


class PhaseMetrics(msgspec.Struct, frozen=True):
    """Robot in a later phase: from a leg of the timeline to the next, or to the end."""

    start_s: float  # [s] time since the common start
    acquired_s: float | None  # [s] time since the start of the phase
    residual: float | None  # [m] worst link, |error| averaged over the last second
    worst: str  # robot at the other end of that link


class Collision(msgspec.Struct, frozen=True):
    """Two robots that touched, or a robot and what stands in the arena."""

    time_s: float  # [s] beginning, since the common start
    first: str  # robot, or the first name that the world reported
    second: str  # robot, obstacle, or `wall`
    impulse: float | None  # [N s] impulse in the world's engine; None where worked out from positions
    overlap: float  # [m] depth


class Approach(msgspec.Struct, frozen=True):
    """Closest approach of a robot to another one, or to an obstacle or wall."""

    between: tuple[str, str]
    gap: float  # [m] distance of the surfaces, negative where they overlapped
    at_s: float  # [s] time since the common start


class ShadowMetrics(msgspec.Struct, frozen=True):
    """Agreement of the shadow twin with its robot; differences are twin less robot, as measured."""

    horizon_s: float | None  # [s] prediction: the twin is put onto the robot this often; None: once
    bias: tuple[float, float, float]  # [m] mean difference along x, y and z of the room
    along: float  # [m] mean difference along the robot's heading, positive where the twin is ahead
    across: float  # [m] mean difference to the left of the heading
    bias_yaw: float  # [rad] mean difference
    rmse: float  # [m] root of the mean squared distance
    rmse_yaw: float  # [rad]
    largest: float  # [m] largest distance
    # Pearson's correlation of positions along x, y and z; None where one of the two hardly moved
    correlation: tuple[float | None, float | None, float | None]
    correlation_speed: float | None  # correlation of the speeds, each over `experiments.metrics.shadow.SPEED_S`
    known: float  # share of the run in which both are known


class CentralisedMetrics(msgspec.Struct, frozen=True):
    """The centralised architecture of one case: goals, delays and load of the central controller."""

    guided: tuple[str, ...]  # robots with goals that it computes
    goals: int  # sent
    goals_hz: float  # [Hz]
    goal_bytes: int  # payload
    goals_lost: int  # not received by their robots; those of the last instant may still have been on their way
    received: int  # poses received
    poses_lost: int  # poses never received: lost, or dropped by the modelled network
    # [s] from the measurement of a pose until the robot acts on the first goal that rests on it; None without goals
    delay_mean_s: float | None
    delay_p95_s: float | None  # [s] 95 % of these delays are shorter
    delay_max_s: float | None  # [s]
    load: float | None  # share of a core; None in virtual time
    load_max: float | None  # load of the busiest second
    missed: int  # decisions skipped, because they were too late


class LawMeasure(msgspec.Struct, frozen=True):
    """A measure of a law that remembers, in the unit of the law."""

    mean: float | None  # mean over the run
    end: float | None  # mean over the last second
    unit: str = ""
    better: Literal["less", "more", ""] = "less"


class RobotMetrics(msgspec.Struct, frozen=True):
    """Metrics of a robot in a case, see `experiments.metrics.metric.FIGURES`; unknown numbers are None."""

    robot: str
    kind: str
    f_hz: float
    messages: int
    bytes: int
    iae: float | None
    itae: float | None
    rmse: float | None
    acquired_s: float | None
    lost: int
    dropped: int
    missed_deadlines: int
    residual: float | None
    worst: str  # robot at the other end of that link
    phases: tuple[PhaseMetrics, ...]  # each later phase
    settle_s: float | None
    missed_share: float | None
    updates: int
    gap_min_s: float | None
    gap_median_s: float | None
    gap_max_s: float | None
    recorded: int
    receivers: int
    received: int
    coverage: float | None
    known: float
    collisions: int
    impulse: float | None
    overlap: float | None
    short: float | None
    near: Approach | None  # closest approach to another robot
    near_arena: Approach | None  # closest approach to an obstacle or a wall
    interventions: int
    intervened_share: float | None
    avoided: int
    avoided_share: float | None
    shadow: ShadowMetrics | None  # None without a shadow twin
    goals: int = 0
    goal_bytes: int = 0
    delay_mean_s: float | None = None
    delay_p95_s: float | None = None
    delay_max_s: float | None = None
    foreign: int = 0
    extra: dict[str, float | None] = {}  # metrics of other distributions, by name
    measures: dict[str, LawMeasure] = {}  # measures of its law, by name

    def value(self, name: str) -> float | None:
        """The value of a metric; None if it is unknown, or was not measured."""
        found: float | None = self.extra.get(name, getattr(self, name, None))
        return found

    @property
    def by_the_end(self) -> tuple[float | None, str]:
        """Residual of the last phase [m], and the robot at the other end of that link."""
        return (self.phases[-1].residual, self.phases[-1].worst) if self.phases else (self.residual, self.worst)


class Belief(msgspec.Struct, frozen=True):
    """Error of a believed position: the last pose received, extrapolated, against the true position of the sender."""

    receiver: str
    sender: str
    rms: float | None  # [m]
    max: float | None  # [m]


class LinkDelivery(msgspec.Struct, frozen=True):
    """Delivery statistics of one link."""

    receiver: str
    sender: str
    received: int  # poses received
    dropped: int  # number dropped by the modelled network
    delay_mean: float | None  # [s] time from the stamp of a pose to its arrival, whatever caused it
    delay_max: float | None  # [s]


class Judged(msgspec.Struct, frozen=True):
    """Number of a run that a criterion of its experiment judges."""

    what: str
    limit: str
    value: float | None  # value over the reference where the limit is; None: unknown
    passed: bool | None  # None: not judged, since the reference was not run


class CaseMetrics(msgspec.Struct, frozen=True):
    """Metrics of a case of a run."""

    case: str
    seed: int
    clock: str  # "real" or "virtual"
    duration_s: float  # [s] length of the trace
    planned_s: float  # [s] length of the experiment
    interrupted: bool  # the run ended before `planned_s`
    tolerance: float  # [m] tolerance of the acquisition
    starts_s: tuple[float, ...]  # [s] start of each phase
    robots: tuple[RobotMetrics, ...]
    leaders: tuple[str, ...]  # robots that the means leave out because they lead
    died: tuple[str, ...]  # robots that the means leave out because their position is unknown for too long
    # each of `known_metrics` averaged over the others, or of the case; `acquired_s` is None if any never acquired
    mean: dict[str, float | None]
    # [s] acquisition of the whole formation per phase, since the start of the phase
    acquired_s: tuple[float | None, ...]
    # [rad/s] net rotation rate of the formation per phase, from acquisition on
    rotation_rad_s: tuple[float | None, ...]
    belief: tuple[Belief, ...]  # one of each link
    excursion: float  # [m] farthest outside the arena
    excursion_robot: str  # empty if none was outside
    lost: int  # sum over the robots
    dropped: int  # number dropped by the modelled network, sum over the robots
    link_deliveries: tuple[LinkDelivery, ...]  # one of each link
    modelled: bool  # the file asks for network effects
    missed_deadlines: int  # sum over the robots
    missed_share: float | None  # missed deadlines over the ticks that were due, of all robots
    collisions: tuple[Collision, ...]  # collisions, ordered by time
    watched: bool  # a world reported contacts; else collisions come from recorded positions
    near: Approach | None  # closest approach of two robots, surface to surface
    near_arena: Approach | None  # closest approach of a robot to an obstacle or a wall
    intervened_share: float | None  # ticks on which safety changed the decision over ticks, of all robots
    avoided_share: float | None  # the same of avoidance
    # lowest simulated over real time that the world reported while it was not paused; None without a world in real
    # time
    world_factor: float | None
    # [s] without any robot's position, all of which came back: the network was away. `known`, `coverage`, acquisition
    # and settling are over the rest
    away_s: float = 0.0
    # times without a robot's position that ended, one phrase each: errors leave them out, acquisition bridges them
    gaps: tuple[str, ...] = ()
    # found by conductor and recorder: robots that began late or early, that an operator held long or took out, messages
    # that could not be read
    troubles: tuple[str, ...] = ()
    # robots that did not do their part: out of reach, lost, did not move, fell, landed or were cut; one sentence each
    failures: tuple[str, ...] = ()
    network_messages: int = 0  # poses of all robots, leaders too, and goals of the central controller
    network_bytes: int = 0  # payload of these messages
    deliveries: int = 0  # arrivals of the same messages, counted once for each receiver
    guidance: CentralisedMetrics | None = None  # None if each robot decides for itself
    # why the figures are compared with none of another case, one clause each, see `metrics.comparable`
    spoiled: tuple[str, ...] = ()
    measures: dict[str, LawMeasure] = {}  # measures of the law by name, means over the robots in the means
    metric_faults: tuple[str, ...] = ()  # metrics of other distributions that failed or cannot be used, a sentence each
    criteria: tuple[Criterion, ...] = ()  # criteria of the experiment
    asked: tuple[str, ...] = ()  # metrics that the experiment names without a limit
    judged: tuple[Judged, ...] = ()  # those that are for this case, as written with all cases of the run

    @property
    def has_errors(self) -> bool:
        """Whether links have errors: any of them has a target."""
        return self.mean.get("j2") is not None
