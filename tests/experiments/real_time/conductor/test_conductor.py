"""The course of a case, the hardware of a run, and what serves it."""

import math
import re
import socket
import threading
from contextlib import ExitStack, nullcontext
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from agents.clock import Clock, uptime
from agents.network import messages
from agents.network.endpoints import Endpoint, free_endpoint
from agents.network.keys import Keys
from agents.network.session import Unreachable
from agents.runtime.router import serve_router
from agents.safety.hazards import failed
from experiments.definition.experiment import Formation, Host, RobotTable, Start
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.problems import DocumentError
from experiments.real_time.conductor import conduct, run_view
from experiments.real_time.conductor import conductor as module
from experiments.real_time.conductor.case_processes import STARTS, CaseContext, CaseProcesses, Death
from experiments.real_time.conductor.conduct import PORT_CHOICES, RunOptions, Supervision, run_setup, with_bodies
from experiments.real_time.conductor.conductor import GO_ON_S, Conductor
from experiments.real_time.conductor.orders import STARTING_S, Emergency
from experiments.real_time.conductor.run_view import NetworkView, Progress, RobotView, RunFailed
from experiments.real_time.hosts import run_registry
from experiments.real_time.hosts.hosts import Hosts
from experiments.real_time.hosts.launcher import LAND_S, ROUTER, Launcher, RouterEnded
from experiments.recording.playback import read
from tests.experiments import recordings as rec
from tests.experiments.recordings import START, status
from tests.small import changed, pair
from tests.waiting import ManualClock

KEYS = Keys()
DEAD = Death("recorder", "conductor", "the recorder ended (killed by SIGKILL); started again")


class Course(Conductor):
    """A conductor whose robots are in `phases`, by the time since the common start; half a second for each look.

    Those of `frozen` stay in the phase that is named there, and say nothing any more.
    """

    def __init__(self, phases, deaths=(), frozen=()):
        self._clock = ManualClock(START, step=0.5)
        self._experiment = changed(document.read("triangle").experiment, duration_s=10.0)
        self.robots = self._robots = {name: RobotView() for name in self._experiment.robots}
        self._progress = Progress("only", "", None, 10.0, self._robots)
        self._phases, self._deaths, self._frozen = phases, dict(deaths), dict(frozen)
        self.failures, self._starting, self._landed, self._held = [], set(), {}, set()
        self.reasons = {}  # of robots that have landed at 3 s, before all others
        self._changes = self._drift = MagicMock(under_way=())
        self._context = MagicMock(ended=lambda: False, emergency=None, launcher=MagicMock(land_s=LAND_S))
        self.processes = self._processes = MagicMock(deaths=self._died, recording=True)
        self.view = self._view = MagicMock(update=self._phase, recorder_stands_still=False, recording_begun=True)
        self.update, self.land = self._update, self._land
        self._show = lambda _: None

    def _show_progress(self): ...

    def _phase(self):
        now = self._clock.now - START
        phase = next(said for at, said in sorted(self._phases.items(), reverse=True) if now >= at)
        for name, view in self._robots.items():
            if name in self._frozen:
                view.status = changed(status(name, at=0.0, started=0.0), phase=self._frozen[name])
                view.seen = START
                continue
            reason = self.reasons.get(name, "") if now >= 3.0 else ""
            view.status = changed(status(name, at=now), phase="landing" if reason else phase, reason=reason)
        return []

    def _died(self):
        return [self._deaths.pop(at) for at in list(self._deaths) if self._clock.now - START >= at]

    def said(self, kind):
        """Events of a kind, without the kind."""
        return [call.args[1:] for call in self.view.report.call_args_list if call.args[0] == kind]

    def walked(self):
        """Failures of the whole course."""
        self.walk(START)
        return self._landings() + self.failures


@pytest.fixture(autouse=True)
def _without_pauses(monkeypatch):
    monkeypatch.setattr(module, "time", SimpleNamespace(sleep=lambda _: None, monotonic=lambda: 0.0))


@pytest.mark.parametrize(("landing", "failures"), [(3.0, ["all robots were down after 3.5 of 10 s"]), (9.6, [])])
def test_a_run_that_ended_early_has_failed(landing, failures):
    assert Course({0.0: "running", landing: "landing"}).walked() == failures
    course = Course({0.0: "running"})
    for view in course.robots.values():
        view.left_because = "lost"
    assert [text.partition(" after")[0] for text in course.walked()] == ["no robot was left"]


@pytest.mark.parametrize(
    ("reason", "spoilt"),
    [("ordered to land", True), ("ordered to stop", True), ("asked to end", True), ("its battery is low", False)],
)
def test_robot_that_was_ordered_down_spoils_the_run(reason, spoilt):
    """Any other landing is a hazard of the recording."""
    course = Course({0.0: "running", 10.0: "landing"})
    name = next(iter(course.robots))
    course.reasons = {name: reason}
    said = course.walked()
    assert [text.split(" of ")[0].rpartition(" ")[0] for text in said] == [f"{name} landed after"] * spoilt
    course = Course({0.0: "running", 10.0: "landing"})
    course.reasons = dict.fromkeys(course.robots, "ordered to land")
    (text,) = course.walked()
    assert re.fullmatch(r"KH01, KH02, CF01 landed after \d\.\d of 10 s: ordered to land by an operator", text)


def test_robots_held_to_the_end_are_known():
    course = Course({0.0: "running"})
    first, second, _ = course.robots
    for phase, reasons in (("running", ("ordered to hold", "ordered to hold", "")), ("landing", ("finished", "", ""))):
        for (name, view), reason in zip(course.robots.items(), reasons, strict=True):
            view.status = changed(status(name, at=1.0), phase=phase, reason=reason)
        course._note_holds()
    assert course._held == {first, second}
    course.robots[second].status = changed(status(second, at=2.0), phase="running", reason="")
    course.robots[first].left_because = "removed"
    course._note_holds()
    assert course._held == set()


@pytest.mark.parametrize(("halted", "flown"), [("", ["one", "two"]), ("KH01 ordered to land by an operator", ["one"])])
def test_no_case_follows_an_operator_who_lands(halted, flown, monkeypatch, tmp_path):
    contexts = {name: MagicMock(ended=lambda: False) for name in ("one", "two")}
    begun = []

    def conductor(context, _show):
        begun.append(next(name for name, each in contexts.items() if each is context))
        return MagicMock(run=lambda: module.CaseResult(tmp_path / "none", None, None, (), (), halted))

    monkeypatch.setattr(conduct, "with_bodies", lambda *_: dict.fromkeys(contexts))
    monkeypatch.setattr(conduct, "run_setup", lambda *_: nullcontext((contexts, [])))
    monkeypatch.setattr(conduct, "Conductor", conductor)
    ended = conduct.conduct(MagicMock(), tmp_path, RunOptions(), Supervision(nullcontext(print), lambda: False))
    assert begun == flown
    assert ended.failures == [f"not run: two, since {halted}"] * bool(halted)


@pytest.fixture
def passing(monkeypatch):
    """Time of the module that passes with the clock of a course."""

    def pass_with(course):
        now = SimpleNamespace(sleep=lambda _: None, monotonic=lambda: course._clock.now)
        monkeypatch.setattr(module, "time", now)
        return course

    return pass_with


def test_robot_that_is_not_ready_is_left_out(passing):
    course = passing(Course({0.0: "ready"}, frozen={"KH02": "idle"}))
    course._experiment = changed(course._experiment, start=Start(missing="go-on", deadline_s=3.0))
    assert course._await_ready()
    assert course._clock.now - START < 3.0 + GO_ON_S, "it has had its time, as all others"
    assert course.robots["KH02"].gone
    assert course.said("failed") == [("KH02", "takes no part: it is not ready: it is idle")]
    begun, course._phases = course._clock.now, {0.0: "airborne"}
    assert course._take_off()
    assert course._clock.now - begun < 2.0
    course._phases = {0.0: "running", course._clock.now - START + 10.0: "landing"}
    begun = course._clock.now
    course.walk(begun)
    assert course._clock.now - begun < 10.0 + 5.0
    assert course._not_down() == ["KH01", "CF01"]
    alone = passing(Course({0.0: "idle"}, frozen={"KH02": "idle"}))
    alone._experiment = course._experiment
    with pytest.raises(RunFailed, match="not ready"):
        alone._await_ready()


@pytest.mark.parametrize(
    ("began", "behind", "kind", "said"),
    [
        (-1.556, 0.001, "failed", "began 1.56 s before the common start"),
        (0.0, 4.5, "failed", "began 4.50 s after the common start"),
        (0.0, -4.5, "failed", "began 4.50 s before the common start"),
        (-0.06, 0.001, "late", "began 0.06 s before the common start"),
        (0.3, 0.05, "late", "began 0.30 s after the common start"),
        (0.04, 0.05, None, None),
        (-0.04, -0.001, None, None),
    ],
)
def test_start_apart_from_all_others_is_told(began, behind, kind, said):
    course = Course({})
    view = course.robots["KH01"]
    view.began, view.behind, course._starting = START + began, behind, {"KH01"}
    course._report_tardy(START)
    assert [call.args for call in course.view.report.call_args_list] == ([(kind, "KH01", said)] if kind else [])
    assert not course._starting


def test_robot_that_never_began_fails_the_run():
    course = Course({0.0: "running", 10.0: "landing"}, frozen={"KH02": "airborne"})
    course._starting = {"KH01", "KH02"}
    course.walk(START)
    course._report_unbegun()
    assert course.said("failed") == [("KH02", "took no part: it did not begin: it is airborne")]


def test_frozen_robot_is_given_up_and_killed_soon(passing):
    course = passing(Course({0.0: "running", 10.0: "landing", 12.0: "done"}, frozen={"KH02": "running"}))
    course.walk(START)
    assert course._clock.now - START < 15.0, "the order to land waits for it no longer"
    course.land()
    assert course._clock.now - START < 15.0 + 1.5 * LAND_S
    assert course.robots["KH02"].left_because == "lost"
    course.processes.kill.assert_called_once_with("KH02")


def test_nothing_flies_without_a_recorder():
    course = Course({0.0: "ready"}, {0.0: DEAD})
    assert course.await_phase("ready", 10.0, recorder=True), "it is awaited again before the start"
    assert course.failures == []
    course.processes.recording = False
    with pytest.raises(RunFailed, match="nothing would be recorded"):
        course.await_phase("ready", 10.0, recorder=True)
    course.view.recorder_stands_still = True
    course.update()
    course.processes.kill_recorder.assert_called_once_with()
    assert Course({0.0: "running", 10.0: "landing"}, {4.0: DEAD}).walked() == [DEAD.text]


def test_order_to_land_is_repeated_until_all_obey(monkeypatch):
    course, asked = Course({0.0: "running", 4.0: "done"}), []
    monkeypatch.setattr(module, "time", SimpleNamespace(sleep=lambda _: None, monotonic=lambda: course._clock.now))
    course.view.order = lambda names, order: asked.append((order.order, names)) or {}
    course.update()
    course.land()
    assert asked[:3] == [("land", list(course.robots))] * 3
    assert not any(view.left_because for view in course.robots.values())


def test_output_of_a_lost_robot_is_told_once():
    course = Course({})
    lost, late = list(course.robots)[:2]
    course.processes.last_line = lambda name: f"last words of {name}"
    course.robots[lost].left_because = "lost"
    told = course.start_failure([lost, late], "could not start")
    counts = [told.count(text) for text in ("could not start", f"last words of {late}", f"last words of {lost}")]
    assert counts == [1, 1, 0]  # the event of its end has them


def test_failure_after_takeoff_tells_of_motion(passing):
    """A drone that bounced for 15 s was told as "nothing has moved"."""
    course = passing(Course({0.0: "ready"}))
    course.view.order = lambda *_: {}
    assert "; nothing has moved\n" in course.start_failure(["CF01"], "not ready after 3 s")
    with pytest.raises(RunFailed, match=r"not airborne after \d+ s; a take-off was ordered: robots may have moved"):
        course._take_off()


@pytest.mark.parametrize(("leaves_at", "refused"), [(0.0, False), (1.0, False), (9.0, True)])
def test_robots_of_another_run_are_not_taken(leaves_at, refused, monkeypatch):
    clock = ManualClock(0.0)
    there = lambda *_: {KEYS.conductor} if clock.now < leaves_at else set()  # noqa: E731
    monkeypatch.setattr("agents.clock.time", clock)
    monkeypatch.setattr(run_view.network, "tokens_present", there)
    with pytest.raises(RunFailed, match="another run is up at this router") if refused else nullcontext():
        run_view.await_sole_conductor(MagicMock(), KEYS)


def test_failure_says_what_others_have_moved():
    course = Course({0.0: "running"})
    course._lifted, (name, view) = False, next(iter(course.robots.items()))
    assert "nothing has moved" in course.start_failure([name], "late")
    view.status = changed(status(name, at=0.0), phase="airborne")
    assert "robots may have moved" in course.start_failure([name], "late")


class View(NetworkView):
    """The network as a conductor sees it, without a network."""

    def __init__(self):
        self.clock, self.robots, self.said = Clock(), {"TB01": RobotView()}, []

    def report(self, *said, **_):
        self.said.append(said)


def test_robots_beginning_is_its_first_status_within_experiment():
    view = View()
    for phase, at in (("airborne", -0.1), ("running", 0.28), ("running", 1.28), ("landing", 2.0)):
        view.receive_status(changed(status(at=at), phase=phase))
    assert view.robots["TB01"].began == START + 0.28
    view.robots["TB01"].forget_process()
    assert view.robots["TB01"].began is None


def test_reason_that_counts_is_reported_once():
    view = View()
    for at, behind in enumerate(("2", "2.01", "2", "-0.5")):
        reason = f"positions of CF01 are stamped {behind} s behind"
        view.receive_status(changed(status(at=float(at)), phase="idle", reason=reason, body=f"silent for {at}.5 s"))
    view.receive_status(changed(status(at=5.0), phase="idle", reason=reason.replace("CF01", "CF02"), body="silent"))
    assert [said[2] for said in view.said if said[0] == "robot"] == [f"idle: {reason.replace('CF01', 'CF02')}"]
    assert [said[2] for said in view.said if said[0] == "body"] == ["silent for 0.5 s", "silent"]


@pytest.mark.parametrize(
    ("reason", "incidents", "fault"),
    [
        ("its control loop hangs: no tick for 0.5 s", (), True),
        ("its control loop hangs: no tick for 0.5 s", ("over: a neighbour is lost, after 2.00 s",), True),
        ("the starter is gone", (), True),
        ("its battery is low", ("land: its battery is low: 5% (limit 10%)",), False),
        ("finished", (), False),
        ("ordered to land", (), False),
        ("ordered to leave", (), False),
        ("asked to end", (), False),
        ("emergency stop by a test", (), False),
    ],
)
def test_unasked_landing_is_a_hazard_with_reason_once(reason, incidents, fault):
    view = View()
    told = [messages.Incident(k + 1, START, text) for k, text in enumerate(incidents)]
    for at, phase in enumerate(("running", "landing", "landing", "done")):
        down = {} if phase == "running" else {"reason": reason, "incidents": told}
        view.receive_status(changed(status(at=float(at)), phase=phase, **down))
    found = [said[2] for said in view.said if said[:2] == ("hazard", "TB01")]
    assert found == [*incidents, *([f"land: {reason}"] if fault else [])]
    assert any(failed(text) for text in found) == (fault or reason == "its battery is low")


RADIO = "radio://0/80/2M/E7E7E7E701"


def test_hardware_is_known_by_address_settings_and_host():
    robots = {
        "CF01": RobotTable(kind="crazyflie", start=[0.0, 0.0], hover=0.5, body=RADIO),
        "TE01": RobotTable(kind="tello", start=[0.5, 0.0], hover=0.5, body="tello"),
        "KH01": RobotTable(kind="khepera4", start=[-0.5, 0.0], body="khepera4://10.0.0.7", device={"port": 344}),
        "KH02": RobotTable(kind="khepera4", start=[-0.5, 0.5]),
        "KH03": RobotTable(kind="khepera4", start=[-0.5, 0.9], body="khepera4-twin"),
    }
    real = pair(robots=robots, formation=Formation())
    away = changed(real, hosts={"lab2": Host(address="ana@lab2", robots=["TE01"])})
    wanted = {"CF01": RADIO, "TE01": "tello on lab2", "KH01": 'khepera4://10.0.0.7 {"port": 344}'}
    assert conduct.hardware([Plan(real), Plan(away)]) == dict.fromkeys(robots, "") | wanted


def registered(robots, title="here", born=None):
    made = run_registry.own_entry("run", title, ["tcp/127.0.0.1:7448"], folder=Path("/runs/other"), robots=robots)
    return made if born is None else changed(made, born=born)


@pytest.mark.parametrize(
    ("mine", "theirs", "refused"),
    [
        ({"CF01": RADIO}, {"CF01": RADIO}, True),
        ({"CF09": RADIO}, {"CF01": RADIO}, True),
        ({"TE01": "tello"}, {"TE01": "tello"}, True),
        ({"TE02": "rmw"}, {"TE01": "rmw"}, False),
        ({"CF01": RADIO}, {"CF01": RADIO[:-1] + "2"}, False),
        ({"CF01": RADIO}, {"CF01": ""}, False),
    ],
)
def test_hardware_that_another_run_has_is_refused(monkeypatch, mine, theirs, refused):
    me, other = registered(mine), registered(theirs, "there", born="another")
    assert conduct.check_other_runs(me, [other], "x.toml") == [], "it has died"
    monkeypatch.setattr(run_registry, "born", lambda _pid: "another")
    there = "there, /runs/other, at tcp/127.0.0.1:7448"
    if not refused:
        told = [f"another run is up with robots of these names ({name}): {there}" for name in mine.keys() & theirs]
        assert conduct.check_other_runs(me, [me, other], "x.toml") == told
        return
    ((name, body),) = mine.items()
    with pytest.raises(DocumentError, match=re.escape(f"{name} ({body}) is in another run, {there}")) as caught:
        conduct.check_other_runs(me, [me, other], "x.toml")
    assert caught.value.problems[0].hint.endswith("or `./zenpark estop --connect tcp/127.0.0.1:7448`")


@pytest.mark.slow
def test_router_that_just_started_is_waited_for():
    endpoint, over = free_endpoint(preferred_port=0), threading.Event()
    with pytest.raises(Unreachable), Emergency().throughout([endpoint], KEYS, "operator", 0.2):
        pass
    late = threading.Timer(0.6, serve_router, ([endpoint], over))
    late.start()
    try:
        with Emergency().throughout([endpoint], KEYS, "operator", STARTING_S):
            pass
    finally:
        over.set()
        late.join()


def case(folder, name="only", listens=()):
    """Context of a case of the triangle, and what its launcher was to start."""
    launcher, plan = MagicMock(), Plan(document.read("triangle").experiment)
    hosts = Hosts(launcher, list(listens))
    context = CaseContext(plan, name, folder, folder / "case.toml", ["tcp/127.0.0.1:7447"], launcher, hosts)
    return context, launcher.start.call_args_list


def test_dead_router_listens_again_where_machines_expect_it(tmp_path):
    context, started = case(tmp_path, listens=["tcp/0.0.0.0:7447"])
    processes = CaseProcesses(context)
    dead = SimpleNamespace(name=ROUTER, exit="killed by SIGKILL")
    said = [processes.again(dead) for _ in range(STARTS)]
    words = (ROUTER, "agents.runtime.router", "--listen", "tcp/0.0.0.0:7447")
    assert [each.args[:4] for each in started] == [words] * (STARTS - 1)
    assert said[0] == (ROUTER, "the router ended (killed by SIGKILL); started again")
    assert said[-1] == (ROUTER, "the router ended (killed by SIGKILL); given up: the robots hold, and land at the end")
    assert processes.again(SimpleNamespace(name="only-KH01", exit="exit code 2")) is None


def test_full_disk_gives_up_a_process_alone(tmp_path):
    context, _ = case(tmp_path, listens=["tcp/0.0.0.0:7447"])
    context.launcher.start.side_effect = OSError(28, "No space left on device")
    _, said = CaseProcesses(context).again(SimpleNamespace(name=ROUTER, exit="killed by SIGKILL"))
    assert "given up" in said


def test_second_recorder_alone_makes_the_recording(tmp_path):
    """The first one was killed before its file was there."""
    context, started = case(tmp_path)
    context.file.parent.mkdir(parents=True)
    recorder = SimpleNamespace(name="only-recorder", exit="killed by SIGKILL", because="")
    context.launcher.start.return_value = recorder
    processes = CaseProcesses(context)
    processes.prepare()
    kind, _ = processes.again(recorder)
    assert kind == "recorder"
    later = Path(started[-1].args[3])
    assert "cannot be read" in processes.join_parts(), "no recorder has made a file"
    rec.write(later, *rec.whole_run())
    assert processes.join_parts() == ""
    assert read(context.recording).complete
    assert not later.exists()


@pytest.mark.system
def test_router_with_port_taken_meanwhile_listens_elsewhere(tmp_path, monkeypatch):
    taken = free_endpoint(preferred_port=0)
    with socket.create_server(("127.0.0.1", Endpoint.parse(taken).port)):
        free = [[taken], [taken], [free_endpoint(preferred_port=0)]]
        chosen = iter(free)
        monkeypatch.setattr(conduct, "free_endpoints", lambda *_, **__: next(chosen))
        read, user = document.read("triangle"), Supervision(nullcontext(), lambda: False)
        with run_setup(read, with_bodies(read, RunOptions()), tmp_path, RunOptions(), user) as (contexts, _):
            assert contexts["event"].endpoints == free[-1]
            (run,) = [run for run in run_registry.runs() if run.folder == str(tmp_path)]
            assert run.endpoints == free[-1]
        chosen = iter([[taken]] * PORT_CHOICES)
        with pytest.raises(RouterEnded, match="already in use"), ExitStack() as up:
            up.enter_context(run_setup(read, with_bodies(read, RunOptions()), tmp_path, RunOptions(), user))


def test_suspended_launcher_knows_when_its_robots_have_landed(tmp_path, monkeypatch):
    launcher, zero = Launcher(tmp_path), uptime()
    for since, silence in ((3.0, -math.inf), (3.7, zero + 3.7), (40.0, zero + 40.0)):
        with monkeypatch.context() as patched:
            patched.setattr("experiments.real_time.hosts.launcher.uptime", lambda at=zero + since: at)
            assert launcher.last_silence == silence


@pytest.mark.parametrize("word", ["experiment", "joining", "changed", "addressed"])
def test_no_name_of_a_case_shares_a_file(tmp_path, word):
    names = ["rights", "run", "metrics", "x", "x-joining", "x-changed", "cases"]
    files = {case(tmp_path, name)[0].variant(word).relative_to(tmp_path).parts for name in names}
    assert len(files) == len(names)
    assert {(parts[0], len(parts)) for parts in files} == {("cases", 3)}
