"""A bare Zenoh process for `./zenpark test --bench process`.

    python -m tests.bench.bare_process ENDPOINT NAME HZ NEIGHBOUR ...

The least that a robot can do: a session with the settings of every robot, its own pose sent at the same rate, the poses
of the same neighbours received, JSON encoded and decoded. No body, no law, no safety.
"""

import sys
import threading
import time

from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import end
from agents.runtime.lifeline import Lifeline

REALM = "bare"  # the robots of these names are in another realm of the same router


def main(endpoint: str, name: str, hz: str, *neighbours: str) -> int:
    """Run until its standard input ends."""
    keys, mime, over = Keys(REALM), messages.MIME["json"], threading.Event()
    Lifeline(over).start()
    with network.open_session([endpoint], name=name, lease_s=network.ROBOT_LEASE_S) as session:
        poses = pubsub.pose_publisher(session, keys.pose(name), mime)
        subscribers = [pubsub.pose_subscriber(session, keys.pose(each)) for each in neighbours]
        due, period, seq = time.monotonic(), 1.0 / float(hz), 0
        while not over.is_set():
            # not by `agents.ticks`, which would add to the yardstick; a late pose is sent all the same
            due += period
            time.sleep(max(0.0, due - time.monotonic()))
            seq += 1
            place = [0.123456 + 1e-6 * seq, -0.5, 0.8]
            poses.put(messages.encode(messages.pose(name, seq, time.time(), place, [0.01, 0.02, 0.0], yaw=0.1), "json"))
            for subscriber in subscribers:
                for sample in network.received(subscriber.handler):
                    messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Pose)
    return 0


if __name__ == "__main__":
    end(lambda: main(*sys.argv[1:]))
