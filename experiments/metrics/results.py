"""What one case of a run comes to: the figures of `experiments.metrics.measure` as structs."""

from __future__ import annotations

from typing import Final

import msgspec

INDICES: Final = (
    *("f_hz", "messages", "bytes", "iae", "itae", "rmse", "acquired_s"),
    *("lost", "dropped", "missed_deadlines"),
)


class Phase(msgspec.Struct, frozen=True):
    """One robot in one later phase: from a leg of the timeline to the next, or to the end."""

    start_s: float  # [s] since the common start
    acquired_s: float | None  # [s] since the start of the phase
    residual: float | None  # [m] worst link, |error| averaged over the last second
    worst: str  # who is at the other end of that link


class Collision(msgspec.Struct, frozen=True):
    """Two robots that touched, or a robot and what stands in the arena.

    Attributes:
        time_s: When it began, since the common start [s].
        first: A robot, or whoever it was that the world named first.
        second: A robot, an obstacle, or `wall`.
        impulse: As the world's engine has it [N s]; None where it was worked out from positions.
        overlap: How deep one was in the other [m].
    """

    time_s: float
    first: str
    second: str
    impulse: float | None
    overlap: float


class Approach(msgspec.Struct, frozen=True):
    """How near a robot came to another one, or to what stands in the arena: who, the gap between their surfaces [m]
    (negative: they overlapped), and when, since the common start [s]."""

    between: tuple[str, str]
    gap: float
    at_s: float


class ShadowMetrics(msgspec.Struct, frozen=True):
    """How far the twin beside a robot agrees with it; differences are twin less robot, as it was measured.

    Attributes:
        horizon_s: How far ahead the twin predicts: it is put onto the robot this often [s]; None: once.
        bias: Mean difference along x, y and z of the room [m].
        along: Mean difference along the robot's heading [m]: positive, the twin is ahead.
        across: Mean difference to the left of it [m].
        bias_yaw: Mean difference of yaw [rad].
        rmse: Root of the mean squared distance [m].
        rmse_yaw: The same of yaw [rad].
        largest: Largest distance [m].
        correlation: Pearson's, of positions along x, y and z; None where one of the two hardly moved.
        correlation_speed: The same of their speeds, each over `experiments.metrics.shadow.SPEED_S`.
        known: Share of the run in which both are known.
    """

    horizon_s: float | None
    bias: tuple[float, float, float]
    along: float
    across: float
    bias_yaw: float
    rmse: float
    rmse_yaw: float
    largest: float
    correlation: tuple[float | None, float | None, float | None]
    correlation_speed: float | None
    known: float


class Guidance(msgspec.Struct, frozen=True):
    """What deciding in one process came to.

    Attributes:
        guided: Robots for which it decided.
        goals: That it sent, and `goals_hz` of them per second.
        goals_hz: See `goals`.
        goal_bytes: Their payload [bytes].
        goals_lost: That did not reach their robots; those of the last instant may still have been under way.
        heard: Poses that it heard.
        poses_lost: And those that it never got, because they were lost or the modelled network dropped them.
        delay_mean_s: From the measurement of a robot's pose to its acting on the first goal that rests on it [s];
            None if no pose was answered.
        delay_p95_s: 95 % of these delays are shorter [s].
        delay_max_s: The longest [s].
        load: Share of a core that its process took; None in virtual time.
        load_max: That of the busiest second.
        missed: Decisions that were too late to be made.
    """

    guided: tuple[str, ...]
    goals: int
    goals_hz: float
    goal_bytes: int
    goals_lost: int
    heard: int
    poses_lost: int
    delay_mean_s: float | None
    delay_p95_s: float | None
    delay_max_s: float | None
    load: float | None
    load_max: float | None
    missed: int


class RobotMetrics(msgspec.Struct, frozen=True):
    """One robot in one case. What cannot be known is None.

    Attributes:
        robot: Name.
        kind: Kind of robot.
        f_hz: Transmissions per second [1/s].
        messages: Transmissions, by the sequence numbers.
        bytes: Payload sent [bytes].
        iae: ∫ e dt [m·s], e = Σ|d − distance| over the links it listens on (over those that listen to it, if none).
        itae: ∫ t·e dt [m·s²].
        rmse: √(mean e²) [m].
        acquired_s: From when on the one-second mean of |error| of each of its links stays within the tolerance until
            the next phase [s]; None if never.
        lost: Samples that the sequence numbers prove were sent and that never came to somebody.
        dropped: Samples of it that the modelled network dropped, over all its listeners.
        missed_deadlines: Ticks that began more than one period late.
        residual: Worst link, |error| averaged over the last second of the first phase [m].
        worst: Who is at the other end of that link.
        phases: The same for each later phase.
        settle_s: When e enters the 2 % band of its largest value for good [s]; the duration if never.
        missed_share: Missed deadlines over ticks.
        updates: How often it computed its goal.
        gap_min_s: Shortest time between two transmissions [s].
        gap_median_s: Median of those times [s].
        gap_max_s: Longest of them [s].
        recorded: Poses in the recording.
        listeners: How many robots listen to it.
        heard: Poses of it that its listeners heard, all together.
        coverage: Share of its link errors that is known.
        known: Share of the run in which its own position is known.
        collisions: How often it touched another robot or what stands in the arena.
        impulse: Hardest of these [N s], None if none is known.
        overlap: Deepest of these [m], None if it touched nothing.
        short: How far from where its plan wanted it a robot with a plan was at the end [m]; None without one.
        near: Closest approach to another robot.
        near_arena: Closest approach to an obstacle or a wall.
        interventions: Ticks on which safety changed what had been decided.
        intervened_share: Those over ticks.
        avoided: Ticks on which avoidance did.
        avoided_share: Those over ticks.
        shadow: How far the twin beside it agrees with it; None without one.
        goals: That a centre sent to it, and `goal_bytes` their payload [bytes].
        goal_bytes: See `goals`.
        delay_mean_s: See `Guidance`; None for robots that decide for themselves.
        delay_p95_s: Likewise [s].
        delay_max_s: Likewise [s].
    """

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
    worst: str
    phases: tuple[Phase, ...]
    settle_s: float
    missed_share: float | None
    updates: int
    gap_min_s: float | None
    gap_median_s: float | None
    gap_max_s: float | None
    recorded: int
    listeners: int
    heard: int
    coverage: float
    known: float
    collisions: int
    impulse: float | None
    overlap: float | None
    short: float | None
    near: Approach | None
    near_arena: Approach | None
    interventions: int
    intervened_share: float | None
    avoided: int
    avoided_share: float | None
    shadow: ShadowMetrics | None
    goals: int = 0
    goal_bytes: int = 0
    delay_mean_s: float | None = None
    delay_p95_s: float | None = None
    delay_max_s: float | None = None

    @property
    def by_the_end(self) -> tuple[float | None, str]:
        """Residual of the last phase [m], and who is at the other end of that link."""
        return (self.phases[-1].residual, self.phases[-1].worst) if self.phases else (self.residual, self.worst)


class Belief(msgspec.Struct, frozen=True):
    """How far what a listener believes of a speaker (the last pose heard, carried on) is from where it is."""

    listener: str
    speaker: str
    rms: float | None  # [m]
    max: float | None  # [m]


class Passage(msgspec.Struct, frozen=True):
    """What became of the poses on one link.

    Attributes:
        listener: Who heard them.
        speaker: Who said them.
        heard: How many arrived.
        dropped: How many the modelled network dropped.
        delay_mean: From when a pose was taken to its arrival, of those heard [s], whatever caused it.
        delay_max: The longest [s].
    """

    listener: str
    speaker: str
    heard: int
    dropped: int
    delay_mean: float | None
    delay_max: float | None


class CaseMetrics(msgspec.Struct, frozen=True):
    """One case of a run.

    Attributes:
        case: Name of the case.
        seed: Seed of the run.
        clock: "real" or "virtual".
        duration_s: Length of the trace [s].
        planned_s: Length that the experiment was to have [s].
        interrupted: Whether the run ended before that.
        tolerance: Of the acquisition [m].
        starts_s: Start of each phase [s].
        robots: One entry per robot.
        leaders: Robots that the means leave out because they lead.
        died: Robots that the means leave out because their position is unknown for too long.
        mean: Each of `INDICES` averaged over the others; `acquired_s` is None if any of them never acquired.
        acquired_s: When the whole formation was acquired, per phase, since the start of the phase [s].
        rotation_rad_s: Net rotation rate of the formation per phase, from acquisition on [rad/s].
        j2: Σ(0.02·messages + 0.1·updates + 0.3·settle_s + 0.1·IAE + 0.01·ITAE), all of the whole run. The weights are
            those of the authors' benchmark cost; theirs counts messages, updates, half the IAE, and ITAE up to the
            settling time only, which it takes from 2 % of the way of Σ(d² − r²). Not comparable.
        belief: Error of what neighbours hold, per link.
        belief_rms: The same over all links [m].
        belief_max: The largest of all [m].
        closest: Smallest distance between two robots' centres [m].
        closest_between: Between whom.
        closest_at_s: When [s].
        excursion: Farthest that a robot was outside the arena [m].
        excursion_robot: Which; empty if none was outside.
        lost: Sum over the robots.
        dropped: Sum over the robots: what the modelled network dropped.
        passages: What became of poses, per link.
        modelled: Whether the file asks for network effects.
        missed_deadlines: Sum over the robots.
        missed_share: Missed deadlines over ticks, of all robots.
        collisions: What touched, in order of time.
        watched: Whether a world watched for contacts; else collisions are worked out from recorded positions.
        near: Closest approach of two robots, surface to surface.
        near_arena: Closest approach of a robot to an obstacle or a wall.
        intervened_share: Ticks on which safety changed what had been decided over ticks, of all robots.
        avoided_share: Ticks on which avoidance did over ticks, of all robots.
        world_factor: Lowest simulated over real time that the world reported while it was not paused; None without a
            world in real time.
        away_s: For how long nobody's position was known and all came back: the network was away. `known`, `coverage`,
            acquisition and settling are over the rest [s].
        troubles: What conductor and recorder found wrong: robots that began late, messages that could not be read.
        network_messages: Of the whole network: poses of all robots, leaders too, and goals of the centre.
        network_bytes: Their payload [bytes].
        deliveries: The same messages, counted once for everybody who listens to them.
        guidance: What deciding in one process came to; None if every robot decides for itself.
    """

    case: str
    seed: int
    clock: str
    duration_s: float
    planned_s: float
    interrupted: bool
    tolerance: float
    starts_s: tuple[float, ...]
    robots: tuple[RobotMetrics, ...]
    leaders: tuple[str, ...]
    died: tuple[str, ...]
    mean: dict[str, float | None]
    acquired_s: tuple[float | None, ...]
    rotation_rad_s: tuple[float | None, ...]
    j2: float
    belief: tuple[Belief, ...]
    belief_rms: float | None
    belief_max: float | None
    closest: float | None
    closest_between: tuple[str, ...]
    closest_at_s: float | None
    excursion: float
    excursion_robot: str
    lost: int
    dropped: int
    passages: tuple[Passage, ...]
    modelled: bool
    missed_deadlines: int
    missed_share: float | None
    collisions: tuple[Collision, ...]
    watched: bool
    near: Approach | None
    near_arena: Approach | None
    intervened_share: float | None
    avoided_share: float | None
    world_factor: float | None
    away_s: float = 0.0
    troubles: tuple[str, ...] = ()
    network_messages: int = 0
    network_bytes: int = 0
    deliveries: int = 0
    guidance: Guidance | None = None
