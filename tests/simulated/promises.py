"""Times, exit codes and guarantees that three pages promise, and the tests that tell when one is broken.

A table has the words of a page, and the tests behind them, with their path below `tests`. Most of them are scripts of
the simulated laboratory. A value without a path says why no test is needed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

NUMBER = r"\d+(?:\.\d+)?"
PROMISE: Final = re.compile(
    rf"(?<![\w.]){NUMBER}(?: (?:to|±) {NUMBER})? (?:s|ms|seconds?|minutes?|hours?)(?![\w/·])"
    rf"|_s` {NUMBER}"
    r"|\b(?:(?:half a|every|every half|three) seconds?|(?:in|for|than) a second|an hour)\b"
    r"|\bexit code\b|\bends? with \d+|^\| \d+ \|"
    r"|\b(?:never|always)\b",
    re.IGNORECASE | re.MULTILINE,
)

HAZARDS = "agents/safety/test_hazards.py::test_outcomes_of_a_lasting_cause"
CAUSES = "agents/safety/test_detection.py::test_causes_of_one_tick"
CAPTURED = "agents/body/test_measured_positions.py::test_"
LOCKS = "agents/body/test_device_locks.py::test_"
MISLED = "agents/safety/test_misleading_positions.py::test_"
MIRRORED = "experiments/virtual_time/test_mirrored.py::test_"
MOTION = "agents/safety/test_motion_check.py::test_"
POSES = "agents/runtime/test_pose_inbox.py::test_"
READY = "agents/safety/test_detection.py::test_reason_why_a_drone_is_not_ready"
STATION = "experiments/real_time/hosts/test_station.py::test_"
MACHINES = "system/test_machines.py::test_"
SPOILED = "experiments/metrics/test_criteria.py::test_what_spoils_a_run"
ROW = "simulated/test_safety.py::test_hazard_of_one_robot"
SCRIPT = "simulated/test_safety.py::test_"
HOST = "simulated/test_hosts.py::test_"
RUN = "simulated/test_runs.py::test_exit_code"
CHECK = "experiments/check/test_check.py::test_"
MEASURED = "measured: docs/results/network.md"
FAILING = f"{HAZARDS} agents/safety/test_detection.py::test_failing_control_loop"
BEYOND = "robots_beyond_are_lost_and_found"
SPLIT = "simulated/test_split.py::test_"
FROZEN = f"{HOST}frozen_robot_is_ordered_down_then_killed"
CUT = f"{MACHINES}machine_cut_off_lands_its_robots_only"
EXAMPLE = "an example of an output"

SAFETY: Final = {
    # the table
    "`position_timeout_s` 0.5 | hold at once": f"{ROW}[stale] {ROW}[blind]",
    "no setpoint is sent | land after `land_without_position_s` 0.3 s": f"{ROW}[blind]",
    "to start | land after `land_without_position_s` 0.3 s": f"{ROW}[jump]",
    'lands no robot; a jump never counts as "far outside"': f"{ROW}[outlier] {ROW}[far_jump]",
    "stamps its positions is wrong, for 0.5 s": f"{CAPTURED}stamps_behind_are_reported_before_positions_expire",
    "stamps are more than 0.1 s later than the arrival": CAUSES,
    "from outside, by more than 0.1 s": CAUSES,
    "stamped 2.3 s ahead": EXAMPLE,
    "a Crazyflie's by more than 0.15 s": f"{CAPTURED}late_positions_are_refused_and_named",
    "farther outside than this, for 0.1 s": f"{ROW}[flies_away]",
    "`separation`, off | hold, until 0.5 s after": HAZARDS,
    "for 0.2 s | `overspeed` 2.5 | hold, until 0.5 s after | land after 1 s": f"{ROW}[overspeed] {HAZARDS}",
    "tilted more than this, for 0.1 s": f"{ROW}[tilt]",
    "`neighbour_timeout_s` 1 s, then it is left out": f"{SCRIPT}lost_neighbour_is_left_out_after_a_second",
    "more than 3 s old on arrival": f"{POSES}poses_that_are_always_old_are_a_hazard",
    "for 0.5 s all poses": f"{POSES}neighbour_whose_poses_are_all_refused_is_lost",
    "stamped more than 5 s ahead": f"{POSES}neighbour_whose_poses_are_all_refused_is_lost",
    "for 1 s a source": HAZARDS,
    "battery low for 1 s": f"{ROW}[battery]",
    "gets no messages for 0.4 s queries its router, and without an answer in 0.3 s": f"{ROW}[hardly_cut]",
    "holds 1.3 to 1.8 s after the loss, and lands 10.3 to 10.8 s after it": f"{ROW}[cut_off] {ROW}[cut_wheels]",
    "ticks that are 0.05 s late on average it holds within 2.5 s": f"{SCRIPT}slow_loop_misses_its_router_as_soon",
    "`neighbour_timeout_s` 1 s | hold | land after `offline_s` 10 s": f"{ROW}[cut_off] {ROW}[cut_shortly]",
    "no conductor for 2 s": f"{HAZARDS} system/test_hazards.py::test_robots_without_conductor_end_if_file_says_so",
    "was not ordered | `offline_s` 10 s": HAZARDS,
    "faster than 0.15 m/s, for 0.1 s": f"{ROW}[sinking]",
    "land after 0.5 s; an interruption of less than a second": HAZARDS,
    "in at least 2 s its setpoints (without slow ones) add up to 1.5 s": f"{MOTION}robot_that_does_not_move",
    "(0.75 s on wheels)": f"{MOTION}wheels_that_ignore_or_need_no_commands",
    "commanded over 10 s": f"{MOTION}slow_motion_against_commands_is_found",
    "to and fro in a second and take effect up to 0.6 s late": f"{MOTION}late_motion_is_not_against_commands",
    "by more than 2 rad, for 0.3 s": f"{MIRRORED}drone_with_wrong_axes_lands_near_its_place",
    "within 1 s at rest, 8 s in motion": f"{MIRRORED}steady_wind_is_no_fault",
    "rise by 5 cm in 4 s (Tello: 10 s": "agents/safety/test_detection.py::test_climb_without_measured_height",
    "halt after 2 s more": f"{ROW}[stuck_wheels]",
    "counts for about 5 s": f"{MOTION}robot_that_moves_without_being_told",
    "the way of 0.5 s at top speed": f"{MOTION}robot_that_moves_without_being_told",
    "motors on for 0.55 s + 0.55 s/m · h + 0.16 s·m / h": f"{MISLED}stuck_climb_is_cut_low",
    "or 0.7 s without the next 5 cm": f"{MISLED}stuck_climb_is_cut_low",
    "more than 0.65 rad, for 0.3 s": f"{HAZARDS} {MISLED}turned_frame_is_cut_early",
    "for 0.5 s longer than this [s] (not of external simulators) | `position_timeout_s` 0.5": f"{ROW}[mute]",
    "more than 1 s old | | hold": "agents/safety/test_detection.py::test_range_sensors_that_fall_silent",
    "`loop_timeout_s` 0.5 s": f"{SCRIPT}suspended_robot_holds_until_it_hears",
    "in a second (of a loop that stood still: after 2.3 s) | | hold, until 0.5 s after | land after 5 s": FAILING,
    "moves aside, for up to 3 s": "agents/safety/test_landing.py::test_search_for_a_place_ends",
    "descended by 5 cm in 2 s": "agents/safety/test_detection.py::test_landing_that_does_no_good_is_cut",
    "`landing_s` 20 s | cut": f"{HAZARDS} agents/safety/test_detection.py::test_landing_that_does_no_good_is_cut",
    "hovers in the air for 2 s | | warn, and every second": f"{SCRIPT}lost_order_to_land_is_repeated",
    "it is never cut there": "agents/safety/test_detection.py::test_hovering_or_slow_drone_is_never_cut",
    "absent for a second": f"{HAZARDS} agents/safety/test_hazards.py::test_cause_that_comes_and_goes",
    # below it
    "ends with exit code 1 and says so": f"{RUN}[landed]",
    "silent for 0.6 s": EXAMPLE,
    "and ends with 1. No case begins": f"{SCRIPT}emergency_stop_ends_the_run",
    "exit code is 1. Where a run": "tools/commands/test_network.py::test_estop_names_both_kinds_of_robots",
    "every half second": f"{SCRIPT}stop_without_router_goes_by_lifelines",
    "land after 3 s without its heartbeat": f"{HOST}frozen_launcher_lands_all_and_gives_no_order",
    "and always `tcp/127.0.0.1:7447`": "tools/commands/test_network.py::test_estop_reaches_each_realm_of_a_router",
    "Name servers have 2 s": f"{LOCKS}silent_name_server_delays_no_robot_for_long",
    "sends nothing and ends with 2": f"{LOCKS}holder_is_named_and_its_death_frees_device",
    "2.5 s without that the status": f"{SCRIPT}stop_that_no_body_confirms_is_told",
    "waits for it (5 s; wheels 3 s)": f"{SCRIPT}stop_that_no_body_obeys_is_told",
    "Two measurements never do": f"{CAPTURED}frozen_motion_capture_lands_what_flies",
    "more than 0.15 s late": f"{CAPTURED}late_positions_are_refused_and_named",
    "positions that are 0.45 s late": f"{CAPTURED}the_first_of_two_sources_stays_until_silent",
    "first 5 cm 0.2 to 0.35 s before the limit": f"{MISLED}usual_climbs_raise_no_alarm",
    "after 0.2 s at most": f"{MISLED}usual_climbs_raise_no_alarm",
    "lands after 6 minutes": f"{CHECK}batteries_ending_before_the_run_are_all_named",
    # before take-off
    "breaks a condition for 0.5 s": "agents/safety/test_detection.py::test_failure_that_lasts_ends_readiness",
    "not after 0.5 s": "agents/safety/test_detection.py::test_drone_does_not_take_off_below_another",
    # how soon
    "within 20 to 98 ms": MEASURED,
    "within\n0.1 s, a frozen one within 1.5 s": f"{SCRIPT}lost_neighbour_is_left_out_after_a_second",
    "`safety.neighbour_timeout_s` (1 s)": f"{SCRIPT}lost_neighbour_is_left_out_after_a_second",
    "does not run for 1.2 s": f"{SCRIPT}lost_neighbour_is_left_out_after_a_second",
    "ends with exit code 2 without any command": f"{SCRIPT}second_process_ends_without_a_command",
    "no other owner for 0.2 s": f"{SCRIPT}robot_asks_for_its_owner_before_anything_else",
    "ends with 2 about 2.5 s later": f"{SCRIPT}former_owner_commands_nothing",
    "more than 1 s of CPU": "fuzz/test_fuzz.py::test_nothing_escapes",
}
HOSTS: Final = {
    "exit code 1 if one cannot": "tools/commands/test_hosts.py::test_check_makes_a_row_of_each",
    "ssh is never asked": f"{STATION}trouble_has_a_cause_and_a_remedy",
    "-0.00 ± 0.06 ms": EXAMPLE,
    "Crazyradio  ✓ 12 ms": EXAMPLE,
    "+200.06 ± 0.04 ms": EXAMPLE,
    "none needed ✓ 11 ms": EXAMPLE,
    "host never gets `ca.key`": f"{MACHINES}machines_get_own_keys_and_fly_through_ssh",
    "every half second": f"{HOST}frozen_launcher_lands_all_and_gives_no_order",
    "3.2 s later no process is left": f"{HOST}killed_launcher_leaves_nobody_aloft",
    "cut off for less than 3 s | its robots hold after 1.3 to 1.8 s": f"{HOST}short_cut_holds_and_goes_on",
    "0.2, 0.6, 1.4, 3.0 and 6.2 s after the cut": "of TCP itself",
    "out for 2 s is of use after 3 s": f"{MACHINES}a_short_cut_of_the_cable_lands_nobody",
    "hold after 1.3 to 1.8 s; all land after 4.5 s of silence": f"{HOST}short_cut_holds_and_goes_on {CUT}",
    "(those on the launcher's machine after 3 s)": f"{HOST}frozen_launcher_lands_all_and_gives_no_order",
    "processes end 12 s later at the latest": f"{MACHINES}machine_cut_off_lands_its_robots_only",
    "land 3 s after the planned end, counts as lost 15 s later": FROZEN,
    "hold 1.3 to 1.8 s after the split": f"{SPLIT}robots_go_to_the_router_of_their_side",
    "side, 3 s after it": f"{SPLIT}robots_go_to_the_router_of_their_side",
    "lost after 2 s (1.8 to 2.5 s with real routers), and left out 1 s later": f"{SPLIT}{BEYOND}",
    "0.15 s after the split in": f"{SPLIT}{BEYOND}",
    "absent for a second. In": f"{SPLIT}{BEYOND}",
    "warn 2 s after its token": f"{SPLIT}conductor_beyond_is_missed_and_the_robots_finish",
    "Exit code 1 in both cases": f"{SPLIT}stop_names_what_it_does_not_reach",
    "At most 0.15 s after that (0.11 s with": f"{SPLIT}of_two_owners_the_later_one_ends",
    "any more, and ends with 2.": f"{SPLIT}of_two_owners_the_later_one_ends",
    "to all robots within 1 s": f"{MACHINES}estop_typed_on_a_machine_stops_all",
    "signals and the exit code on": "experiments/real_time/processes/test_zygote.py::test_exit_codes_are_passed_on",
    "(± 0.05 ms here)": MEASURED,
    "a clock 0.2 s off, a neighbour is predicted 0.2 s": f"{HOST}clock_of_another_machine[behind]",
    "0.2 s older than it is, and starts 0.2 s early": f"{HOST}clock_of_another_machine[behind]",
    "read again every second": f"{STATION}remaining_drift_stays_small_whatever_the_runs_length",
    "more than 0.5 s at once": "agents/test_clock.py::test_absurd_corrections_and_jumps_are_not_followed",
    "stamps never go back": "agents/test_clock.py::test_clock_follows_smoothly_and_never_back",
    "within 0.5 ms for an hour": MEASURED,
    "200 ms and 50 ppm on one of three machines, starts and stamps agreed within 1.3 ms": MEASURED,
    "more than 20 ms (0.1 s)": f"{HOST}clock_of_another_machine[ahead]",
    "three seconds after that is gone": "system/test_hot_changes.py::test_who_joined_lands_when_the_conductor_is_dead",
    "Restart=always": "of systemd",
}
RUNS: Final = {
    "| 0 | the run went to its end": f"{RUN}[undisturbed]",
    "| 1 | a robot failed": f"{RUN}[landed]",
    "more than a second before or after": f"{RUN}[early_by_seconds]",
    "| 2 | nothing was flown": f"{RUN}[not_ready]",
    "| 3 | the run went to its end": f"{RUN}[held]",
    "| 130 | the user": f"{RUN}[interrupted]",
    "started again ends with 0": f"{RUN}[router_restarted] {RUN}[centre_restarted] {RUN}[stood]",
    "does not change the exit code": "experiments/metrics/test_criteria.py::test_what_was_not_run_is_not_judged",
    "hangs about 5 s after its last sign": "simulated/test_runs.py::test_recorder_that_hangs_is_replaced",
    "and ends with 1. Report": "experiments/recording/test_bundle.py::test_what_comes_out_otherwise_is_said",
    "more than 0.05 s before or after": f"{RUN}[early]",
    "up to 0.1 s slow": f"{RUN}[clock_slow]",
    "if it was never added": "experiments/metrics/test_measure.py::test_unseen_and_unlinked_robots_have_no_errors",
    "transmits in a second": "experiments/metrics/test_measure.py::test_transmissions_rates_and_gaps",
}
PAGES: Final[Mapping[str, Mapping[str, str]]] = {"safety": SAFETY, "hosts": HOSTS, "runs": RUNS}
