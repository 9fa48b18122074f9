"""Defects that are put into the product: each breaks the script that is written for its sentence."""

from functools import partial

import pytest

from tests.cases import mostly_slow
from tests.simulated import laboratory, test_changes, test_hosts, test_runs, test_safety, test_split
from tests.simulated.laboratory import Mutant

LIMIT_S = 45.0  # longest flight of a script, and twice the time to land
RUNTIME, CONDUCTOR = "agents/runtime/", "experiments/real_time/conductor/"
LOOP, WATCHDOG, HOT = f"{RUNTIME}loop.py", f"{RUNTIME}watchdog.py", f"{CONDUCTOR}hot_changes.py"
DESCENT = f"{RUNTIME}descent.py"
OWNERSHIP, MEASURE = "agents/network/name_ownership.py", "experiments/metrics/measure.py"
HAZARDS, DETECTION = "agents/safety/hazards.py", "agents/safety/detection.py"


def row(name):
    """Script of one row of the hazards."""
    long = name in test_safety.LONG_ROWS
    rows = test_safety.LONG_ROWS if long else test_safety.ROWS
    found = test_safety.fly_rows({name: rows[name]}, 12.5 if long else 4.0)
    test_safety.check_row(name, found[name])


def former_owner(name):
    return partial(test_safety.test_former_owner_commands_nothing, *test_safety.DISPLACED[name])


def run(name):
    return partial(test_runs.test_exit_code, name)


# file, what stands there, what the mutant has instead, script
MUTANTS = {
    "owner not asked after a cut": (
        DESCENT, "if ownership.check_return(session) or stood:", "if False:", former_owner("long cut"),
    ),
    "other owner forgotten when cut off again": (
        DESCENT, "stood or ownership.contested or", "stood or", former_owner("cut off again"),
    ),
    "robot that waits for its owner for good": (
        DESCENT, "self._resigned = True", "pass",
        test_safety.test_robot_without_an_answer_about_its_owner_lands,
    ),
    "time of asking is no matter": (
        DESCENT, "robot.hazards.since[Cause.OWNER] = robot.health.asked_since", "pass", run("asks_for_its_owner"),
    ),
    "displaced body landed by the watchdog": (
        WATCHDOG, "displaced = self._displaced()", "displaced = False", former_owner("in a loop that hangs"),
    ),
    "owner asked for after the second answer": (
        "agents/network/session.py", "return self._answers > 0", "return self._answers > 1",
        partial(test_safety.test_robot_asks_for_its_owner_before_anything_else, test_safety.SHORTLY_SILENT[0]),
    ),
    "empty answer not asked for again": (
        OWNERSHIP, "if tokens or tokens is None:", "if True:",
        partial(test_safety.test_two_robots_of_a_process_keep_their_names, 1),
    ),
    "stop left to the loop": (
        LOOP, "        if self._opened:\n            self._body.stop", "        if False:\n            self._body.stop",
        test_safety.test_emergency_stop_ends_the_run,
    ),
    "one round of claims": (
        OWNERSHIP, "if others := rivals(owners=False):", "if False:",
        test_safety.test_two_processes_that_claim_a_name_at_once,
    ),
    "stopped body is driven on": (
        LOOP, "robot.lifecycle.stop(stop.words)", "pass", test_safety.test_emergency_stop_ends_the_run,
    ),
    "hold ended by the common start": (
        "agents/robot.py", "if not (airborne and self._ordered):", "if True:",
        test_safety.test_robot_that_was_ordered_to_hold_holds,
    ),
    "body that cannot be read falls": (
        DESCENT, "            self._order_down(self._body.land, self.limit_s)\n", "            pass\n",
        test_safety.test_body_that_cannot_be_read_is_landed,
    ),
    "landing with token and poses": (
        LOOP, "if down and (unasked or row in self._orders.leaving) and row not in self._retired:", "if False:",
        test_safety.test_landing_by_a_hazard_is_lost_at_once,
    ),
    "silent router unseen": (
        "agents/network/session.py", "> ANSWER_S and self._silent_since", "> 99.0 and self._silent_since",
        partial(row, "cut_shortly"),
    ),
    "vanished token not forgotten": (
        f"{RUNTIME}pose_order.py", "+ ([session] if stands else [])", "+ [session]",
        test_changes.test_killed_robot_is_restarted_and_takes_part,
    ),
    "end of the lifeline ignored": (
        f"{RUNTIME}lifeline.py", "        self._lost.set()", "        pass",
        test_hosts.test_killed_launcher_leaves_nobody_aloft,
    ),
    "ordered landing fails no run": (
        f"{CONDUCTOR}conductor.py", ".startswith((LAND, STOP, TOLD_TO_END)):", ".startswith('nothing'):", run("landed"),
    ),
    "second claim wins": (
        OWNERSHIP, "return other < rank if other is not None else owners and", "return False and",
        test_safety.test_second_process_ends_without_a_command,
    ),
    "loss of a neighbour not noted": (
        DETECTION, "if status.cruising and is_lost(", "if False and is_lost(",
        test_safety.test_lost_neighbour_is_left_out_after_a_second,
    ),
    "twice the time to land": (
        f"{CONDUCTOR}conductor.py", "time.monotonic() + land_s, -inf", "time.monotonic() + 2.0 * land_s, -inf",
        test_hosts.test_frozen_robot_is_ordered_down_then_killed,
    ),
    "hold not lifted": (
        "agents/robot.py", "        self._ordered = False\n        if self.lifecycle.reason == PAUSED:",
        "        if self.lifecycle.reason == PAUSED:", test_safety.test_robot_that_was_ordered_to_hold_holds,
    ),
    "parts of a recording not joined": (
        f"{CONDUCTOR}case_processes.py", "if len(self._parts) < 2:", "if len(self._parts) < 9:",
        test_runs.test_recorder_that_hangs_is_replaced,
    ),
    "start apart by less than a second": (
        f"{CONDUCTOR}conductor.py", "if abs(off) > TARDY_S:", "if abs(off) > LATE_S:", run("early"),
    ),
    "removed robot is no matter": (MEASURE, "*_taken_out(trace).values(),", "", run("removed")),
    "no word of a wrong clock": (
        f"{CONDUCTOR}conductor.py", "if not view.gone and view.clock_off:", "if not view:",
        partial(test_hosts.test_clock_of_another_machine, "behind"),
    ),
    "spare does not take part": (
        HOT, "            self._spares.used[spare] = name\n        yield from self._join(names)",
        "            self._spares.used[spare] = name\n        yield",
        test_changes.test_spare_takes_over_name_of_frozen_robot,
    ),
    "removal leaves the token": (
        LOOP, "                self.keeper.withdraw((row,))", "                pass",
        test_changes.test_removed_drone_leaves_formation_before_it_is_down,
    ),
    "restart begins at 0": (
        HOT, 'messages.Order("start", at=self._start', 'messages.Order("start", at=self._view.clock.utc()',
        test_changes.test_killed_robot_is_restarted_and_takes_part,
    ),
    "watchdog that does not land": (
        WATCHDOG, 'self._order_each("land", self._body.land)', "pass",
        test_safety.test_hanging_loop_is_landed_then_cut,
    ),
    "watchdog that does not end": (
        WATCHDOG, "if looked - hung > self.down_s:", "if False:", test_safety.test_hanging_loop_is_landed_then_cut,
    ),
    "twice the time without router": (
        HAZARDS, '"then_s": limits.offline_s}', '"then_s": 2.0 * limits.offline_s}', partial(row, "cut_off"),
    ),
    "twice the time without position": (
        HAZARDS, "if limits.hold_s is None else limits.hold_s}", "if False else 0.6}",
        partial(row, "blind"),
    ),
    "land ordered once": (
        "agents/robot.py", "self.lands, self._land_again_at = True, now", "self._land_again_at = now",
        test_safety.test_lost_order_to_land_is_repeated,
    ),
    "unconfirmed stop is no matter": (
        "bridges/external.py", "- robot.stopped_since > UNANSWERED_S", "- robot.stopped_since > 99.0",
        test_safety.test_stop_that_no_body_confirms_is_told,
    ),
    "jump believed": (
        "agents/safety/positions.py", "        return gap if self.jumped else nan", "        return nan",
        partial(row, "jump"),
    ),
    "stop not passed on to lifelines": (
        f"{CONDUCTOR}orders.py", "            self.launcher.stop(stop)", "            pass",
        test_safety.test_stop_without_router_goes_by_lifelines,
    ),
    "world that waits for its robots to be stopped": (
        "experiments/real_time/processes/world.py", "if self._stopped.is_set():", "if False:",
        partial(test_safety.test_world_obeys_a_stop_itself, test_safety.UNHEARD["router suspended"]),
    ),
    "order repeated ten times a second": (
        "bridges/external.py", "elif due or not robot.obeys(now):", "elif due:",
        partial(test_safety.test_orders_are_repeated_on_every_tick, *test_safety.REPEATED["stop"]),
    ),
    "order of a broken loop repeated twice a second": (
        DESCENT, "self._body.command(self._no_setpoints)", "pass",
        partial(test_safety.test_orders_are_repeated_on_every_tick, *test_safety.REPEATED["broken loop"]),
    ),
    "router looked for on some ticks of a slow loop": (
        LOOP, "        self._router_due = -inf  # a slow loop looks on each of its ticks\n", "",
        partial(test_safety.test_slow_loop_misses_its_router_as_soon, 1),
    ),
    "down while it begins to climb": (
        "bridges/measured_flight.py", "down = came_down or grounded_s > GROUNDED_S", "down = True",
        partial(test_safety.test_robot_ordered_down_in_its_climb_lands, "loss"),
    ),
    "events on the network alone": (
        f"{CONDUCTOR}run_view.py", "self._launcher.tell(self._recorder, event_line(event))", "pass",
        run("told_too_late_for_the_recorder"),
    ),
    "landing that is as late as its news": (
        f"{CONDUCTOR}conductor.py", "view.status.ended + view.clock_off - start", "view.status.stamp - start",
        run("stopped_while_the_run_was_cut_off"),
    ),
    "hold that is as late as its news": (
        f"{CONDUCTOR}run_view.py", "min(at + view.clock_off, now)", "now", run("held_while_the_run_was_cut_off"),
    ),
    "thawed launcher goes on": (
        f"{CONDUCTOR}run_view.py", "if self._launcher.last_silence > self._begun:", "if False:",
        test_hosts.test_frozen_launcher_lands_all_and_gives_no_order,
    ),
    "broken recording is no matter": (
        MEASURE, "if (ended_early(trace) or unrecorded) and not", "if False and not", run("recorder_hangs_to_the_end"),
    ),
    "wrong distances of robots": (
        "experiments/metrics/signals.py", "norm(position[:, i + 1 :] - position[:, i, None])",
        "norm(position[:, i + 1 :])", run("shortly_held"),
    ),
    "long hold is no matter": (MEASURE, "if ordered > HELD * end:", "if ordered > end:", run("held")),
    "two owners for good": (
        OWNERSHIP, "                self._taken = key\n", "                pass\n",
        partial(test_split.test_of_two_owners_the_later_one_ends, "second process"),
    ),
    "owner that was away objects": (
        OWNERSHIP, "or uptime() - self.awake_at >= self._stood_s):", "):",
        partial(test_split.test_owner_that_was_away_does_not_object, 5.0, 0.9),
    ),
    "suspension unnoticed": (
        LOOP, "if missed * self._dt > self._setup.loop_timeout_s:", "if missed * self._dt > 99.0:",
        test_safety.test_suspended_robot_holds_until_it_hears,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", mostly_slow(MUTANTS, 2))
def test_script_finds_the_mutant(name, monkeypatch):
    file, old, new, script = MUTANTS[name]
    for module in (test_changes, test_hosts, test_runs, test_safety, test_split):
        monkeypatch.setattr(module, "fly", partial(laboratory.fly, mutant=Mutant(file, old, new), limit_s=LIMIT_S))
    with pytest.raises((AssertionError, ValueError, IndexError, StopIteration)):
        script()
