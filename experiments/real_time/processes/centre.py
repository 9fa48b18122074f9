"""The process of the central controller: `python -m experiments.real_time.processes.centre FILE`.

It receives the poses of the guided robots and of their neighbours, as any neighbour would, and sends each robot its
goal. `agents.decision.centralised` decides; here are the clock and the network. After a restart it receives the last
poses, and from the robots' statuses the time and place of each start; laws with a memory restart. It runs on the
machine of the conductor, with the clock of the experiment.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from math import inf, isfinite, nan
from typing import Final

from agents.clock import Clock, uptime
from agents.decision.centralised import Centre, CentreGoal
from agents.decision.lifecycle import IDLE, PHASES
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import end
from agents.network.validation import valid_box_of
from agents.runtime import command_line
from agents.runtime.pose_inbox import ModelledInbox
from agents.runtime.telemetry import resident_mb
from agents.ticks import Ticks
from experiments.definition.link_conditions import TO_CENTRE, conditions_of
from experiments.definition.plan import Plan
from experiments.file.problems import refusal
from experiments.real_time.processes.joining import Launch, Network, joined

REPORT_S: Final = 1.0
DEPTH: Final = 64  # queued poses of a robot
ROUNDING_S: Final = 1e-5  # stamps are rounded


class CentreProcess:
    """Clock and network of a central controller."""

    def __init__(self, plan: Plan, joint: Network, clock: Callable[[], float] = uptime) -> None:
        """Declares all but the token, which tells that orders are received."""
        session, keys = joint.session, joint.keys
        experiment, names = plan.experiment, plan.names
        self._names = names
        self.centre = centre = Centre([plan.assignment(name, centrally=True) for name in names])
        common = centre.assignments[0]  # rates, limits and duration are those of the experiment
        self._duration = common.duration
        self._session, self._keys = session, keys
        self._ownership = joint.ownership
        self._router = network.RouterWatch(session, keys.centre_alive, joint.endpoints)
        self._cut_off = False
        self._encoding: messages.Encoding = experiment.network.encoding
        self.ticks = Ticks(common.body_hz / common.decide_every, clock=clock)
        # poses that are sent on the tick of a decision arrive within half a tick, and still count
        self.patience_s = 0.5 / common.body_hz
        rows, ends = centre.needed, [(name, name) for name in names]
        self._poses = ModelledInbox(
            session, keys, {names[row]: [row] for row in rows},
            conditions_of(plan, ends, experiment.seed, stream=TO_CENTRE, real=True),
            [(centre, row) for row in range(len(names))],
            valid_box=valid_box_of(common.limits.low, common.limits.high), rate=experiment.rates.pose_hz, depth=DEPTH,
            counted=self._within_run,
        )  # fmt: skip
        self._received = [0] * len(names)
        self.guided = [row for row in rows if centre.robots[row].guided]
        self._statuses = {
            row: pubsub.Inbox(pubsub.pose_subscriber(session, keys.status(names[row])), messages.Status, keys=keys)
            for row in self.guided
        }
        mime = messages.MIME[self._encoding]
        self._goals = {row: pubsub.publisher(session, keys.goal(names[row]), mime) for row in self.guided}
        remembering = [row for row in self.guided if centre.robots[row].computer.stepping is not None]
        self._memories = {row: pubsub.publisher(session, keys.memory(names[row]), mime) for row in remembering}
        self._reports = pubsub.pose_publisher(session, keys.centre, messages.JSON)
        self._phase, self._start = [IDLE] * len(names), [inf] * len(names)
        self._begun = inf
        self._clock = Clock()
        self._seq = round(self._clock.utc() * 1e3)  # greater than any number of a former central controller
        self._sent = self.missed = 0
        self.late_s, self._reported = 0.0, 0.0
        self._cpu_s = time.process_time()

    def run(self, over: threading.Event) -> None:
        """Decides until `over` is set."""
        command_line.spare_imports()
        ticks = self.ticks
        self._utc = self._clock.at(ticks.start())
        ticks.zero += self.patience_s
        token = pubsub.alive_token(self._session, self._keys.centre_alive)
        while not over.wait(ticks.until_next()):
            if self._ownership.wait_while_checking(self._session, over.is_set):
                continue
            ticks.until_next()  # a wait that lasted too long skips as well: goals for a past instant are useless
            missed = ticks.begin()
            self.missed += missed
            self.late_s = max(self.late_s, missed * ticks.period + ticks.late_s)
            t = ticks.t
            self._receive(t)
            goals = self.centre.decide(t, self._phase, self._start)
            if not self._ownership.wait_while_checking(self._session, over.is_set):
                self._send(goals, t)
                self._send_memories(t)
            if t - self._reported >= REPORT_S - 1e-6:
                self._report(t)
        self._report(ticks.next)
        token.undeclare()

    def _receive(self, t: float) -> None:
        was_cut_off, self._cut_off = self._cut_off, isfinite(self._router.silent_since(t))
        if was_cut_off and not self._cut_off:
            self._ownership.begin(self._session)
        for row, inbox in self._statuses.items():
            for status in inbox.read(_check_status):
                self._update_status(row, status)
        begun = min(self._start[row] for row in self.guided)
        if begun != self._begun:
            self._begun = begun
            if isfinite(begun):  # decisions fall on the same instants as those of the robots
                self.ticks.align(begun)
        for row, arrival, received in self._poses.receive(t, self._utc, lambda _: begun):
            pose = received.pose
            yaw = nan if pose.yaw is None else pose.yaw
            velocity = pose.velocity or messages.STILL
            self.centre.receive(row, pose.position, velocity, received.measured - self._utc, arrival, yaw=yaw)
            self._received[row] += self._within_run(pose.stamp - self._utc)

    def _within_run(self, stamp: float) -> bool:
        """Whether a pose was measured in the run that began last."""
        return 0.0 <= stamp - self._begun + ROUNDING_S < self._duration

    def _update_status(self, row: int, status: messages.Status) -> None:
        self._phase[row] = PHASES[status.phase]
        if status.origin is not None and all(map(isfinite, status.origin)):
            self.centre.begin_plan(row, status.origin)
        self.centre.robots[row].held = status.hazard.startswith("hold")
        self._start[row] = status.started - self._utc if status.started > 0.0 else inf

    def _send(self, goals: Sequence[CentreGoal], t: float) -> None:
        self._seq += 1
        stamp = round(self._utc + t, 6)
        for row, (x, y, z), yaw, pose_stamp, velocity in goals:
            place, turned = (round(x, 6), round(y, 6), round(z, 6)), round(yaw, 6) if isfinite(yaw) else None
            measured, wanted = round(self._utc + pose_stamp, 6), messages.wanted(velocity)
            goal = messages.Goal(self._names[row], self._seq, stamp, place, turned, measured, wanted)
            self._goals[row].put(messages.encode(goal, self._encoding))
        self._sent += len(goals)

    def _send_memories(self, t: float) -> None:
        for row, publisher in self._memories.items():
            stepping = self.centre.robots[row].computer.stepping
            if stepping is not None:
                memory = messages.memory(self._names[row], self._seq, self._utc + t, stepping.memory, stepping.measures)
                publisher.put(messages.encode(memory, self._encoding))

    def _report(self, t: float) -> None:
        cpu_s = time.process_time()
        senders = {sender.links[0]: sender for sender in self._poses.senders}  # senders by row
        report = messages.CentreState(
            stamp=self._utc + t,
            robots=[self._names[row] for row in self.guided],
            missing=[self._names[row] for row in self.centre.missing_robots()],
            load=round((cpu_s - self._cpu_s) / max(t - self._reported, self.ticks.period), 4),
            late_s=round(self.late_s, 6),
            decisions=self.centre.decisions,
            missed=self.missed,
            goals=self._sent,
            received={sender.name: self._received[row] for row, sender in senders.items()},
            lost={sender.name: sender.lost for sender in senders.values()},
            dropped={sender.name: self._poses.dropped[row] for row, sender in senders.items()},
            malformed=sum(inbox.malformed for inbox in self._statuses.values()) + self._poses.malformed,
            pid=os.getpid(),
            cpu_s=cpu_s,
            rss_mb=resident_mb(),
        )
        self._cpu_s, self._reported = cpu_s, t
        self.late_s = 0.0
        self._reports.put(messages.encode(report))


def _check_status(status: messages.Status) -> None:
    if status.phase not in PHASES or not isfinite(status.started):
        raise messages.Malformed(f"phase '{status.phase}' or start {status.started} is impossible")


def serve(launch: Launch) -> int:
    """Runs the centre of an experiment until it is asked to end; returns the exit code."""
    plan, endpoints = launch.read()
    experiment, guided = plan.experiment, plan.guided
    if not guided:
        hint = 'write architecture = "centralised" at the top of the file, or choose another case with --case'
        raise refusal(launch.file, "every robot of this experiment decides for itself", hint)
    over = threading.Event()
    with joined(
        plan,
        endpoints,
        name="centre",
        stop=over,
        on_signal=over.set,
        lost=over if launch.lifeline else None,
        token=Keys(experiment.network.realm).centre_alive,
        taken="a centre guides the robots",
    ) as joint:
        process = CentreProcess(plan, joint)
        joint.declared.append(process)
        others = [name for name in plan.names if name not in guided]
        print(
            f"centre ready: guides {', '.join(guided)} at {experiment.rates.coordination_hz:g} Hz"
            + (f"; {', '.join(others)} decide for themselves" if others else "")
            + f"; realm {experiment.network.realm} at {', '.join(endpoints)}",
            flush=True,
        )
        process.run(over)
    return 0


if __name__ == "__main__":
    end(lambda: command_line.run("zenpark centre", Launch, serve))
