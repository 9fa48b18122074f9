"""A bare Zenoh process for `./zenpark bench process`.

    python -m tools.bench.bare_process NAME HZ NEIGHBOUR ... --connect E

The least that a robot can do: a session with the settings of every robot, its own pose sent at the same rate, the poses
of the same neighbours received, JSON encoded and decoded. No body, no law, no safety.
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Sequence

from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import end
from agents.runtime.lifeline import Lifeline

REALM = "bare"  # the robots of these names are in another realm of the same router


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until its standard input ends."""
    parser = argparse.ArgumentParser(description="Sends and receives poses.")
    parser.add_argument("name")
    parser.add_argument("hz", type=float)
    parser.add_argument("neighbours", nargs="*", metavar="NEIGHBOUR")
    parser.add_argument("--connect", action="append", metavar="ENDPOINT")
    chosen = parser.parse_args(arguments)
    keys, mime, over = Keys(REALM), messages.MIME["json"], threading.Event()
    Lifeline(over).start()
    with network.open_session(chosen.connect, name=chosen.name, lease_s=network.ROBOT_LEASE_S) as session:
        poses = pubsub.pose_publisher(session, keys.pose(chosen.name), mime)
        subscribers = [pubsub.pose_subscriber(session, keys.pose(name)) for name in chosen.neighbours]
        due, period, seq = time.monotonic(), 1.0 / chosen.hz, 0
        while not over.is_set():
            # not by `agents.ticks`, which would add to the yardstick; a late pose is sent all the same
            due += period
            time.sleep(max(0.0, due - time.monotonic()))
            seq += 1
            place = [0.123456 + 1e-6 * seq, -0.5, 0.8]
            poses.put(
                messages.encode(messages.pose(chosen.name, seq, time.time(), place, [0.01, 0.02, 0.0], 0.1), "json")
            )
            for subscriber in subscribers:
                for sample in network.received(subscriber.handler):
                    messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Pose)
    return 0


if __name__ == "__main__":
    end(main())
