"""The formation that all simulators fly, and what a measuring process writes.

Robots stand on a circle, 0.6 m apart; each knows the offsets to the robot before and the robot behind it. The law is
the consensus on offsets of Oh, Park and Ahn (Automatica 53, 2015), one numpy expression for all robots.
"""

import json
import sys
import time

import numpy as np

STEP_S = 0.02  # of the law, and of the bodies where the simulator lets us choose
SPACING = 0.6  # [m]
SCATTER = 0.1  # of the starts, on each axis [m]
GAIN = 1.0  # gain of robots with velocities as commands [1/s]
CLOSER = {"khepera4": 0.5, "crazyflie": 0.2}  # gain of robots with places as commands: less for those that lag
LARGEST = 0.2  # speed on each axis [m/s], or way to the next place [m]
WARM_UP = 20  # steps, the first one compiles
MOST_STEPS = 500  # of one measurement: 10 s
ENOUGH_S = 2.0  # CPU time of one measurement, where MOST_STEPS take longer
FEWEST_STEPS = 5
SETTLED_S = 5.0  # after which the links' errors have fallen in whatever simulator


def places(robots):
    """Places (N, 2) of the formation [m]."""
    angle = 2.0 * np.pi * np.arange(robots) / robots
    radius = 0.5 * SPACING / np.sin(np.pi / robots)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def starts(robots):
    """Starts (N, 2) [m], the same for every simulator."""
    return places(robots) + np.random.default_rng(1).uniform(-SCATTER, SCATTER, (robots, 2))


def neighbour_errors(position, place):
    """Missing offsets to both neighbours (N, 2), summed over the two links of each robot [m]."""
    lacking = position - place
    return np.roll(lacking, 1, axis=0) + np.roll(lacking, -1, axis=0) - 2.0 * lacking


def velocities(position, place):
    """Velocity (N, 2) that the law asks of each robot [m/s]."""
    return np.clip(GAIN * neighbour_errors(position, place), -LARGEST, LARGEST)


def goals(position, place, kind):
    """Place (N, 2) to which the law sends each robot [m]."""
    return position + np.clip(CLOSER[kind] * neighbour_errors(position, place), -LARGEST, LARGEST)


def wheels(velocity, yaw):
    """Speed [m/s] and rate of turn [rad/s] (N,) of robots on wheels; the point 5 cm ahead has this velocity."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    ahead = cosine * velocity[:, 0] + sine * velocity[:, 1]
    aside = cosine * velocity[:, 1] - sine * velocity[:, 0]
    return ahead, aside / 0.05


def link_error(position):
    """Mean error of the links' offsets [m]."""
    lacking = position - places(len(position))
    return float(np.linalg.norm(lacking - np.roll(lacking, 1, axis=0), axis=1).mean())


def serve(start, version, step_s=STEP_S):
    """Measure a loop of steps.

    Args:
        start: Takes the number of robots, and gives a function that does one step, law included, and returns the
            positions (N, 2) after it [m].
        step_s: Simulated time of a step [s].
    """
    robots = int(sys.argv[1])
    step = start(robots)
    before = link_error(starts(robots))

    def cpu_s(steps):
        begin = time.process_time()
        for _ in range(steps):
            position = step()
        return time.process_time() - begin, position

    cpu_s(WARM_UP)
    cost = max(cpu_s(FEWEST_STEPS)[0] / FEWEST_STEPS, 1e-6)
    steps = int(min(MOST_STEPS, max(FEWEST_STEPS, ENOUGH_S / cost)))
    taken, position = cpu_s(steps)
    total, after = WARM_UP + FEWEST_STEPS + steps, link_error(position)
    if total * step_s >= SETTLED_S and not after < 0.6 * before:  # not a number is no less either
        raise SystemExit(f"links are off by {after:.3f} m after {total} steps, by {before:.3f} m at the start")
    answer({"cpu_s": taken, "agent_steps": steps * robots}, version, step_s)


def answer(figures, version, step_s):
    """Write what was measured, as the last line of the output."""
    print(json.dumps({"version": version, "step_s": step_s, **figures}), flush=True)
