"""What tests ask of a real rclpy, in its own Python, without zenpark: `rclpy_side.py types | drive | command ...`."""

import importlib
import json
import subprocess
import sys
import time

import rclpy
from rclpy.serialization import deserialize_message, serialize_message

PERIOD_S = 0.05  # of a commander
PATIENCE_S = 80.0
DRIVER = "turtlebot3_node"


def class_of(kind):
    package, _, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def types(payloads):
    """Hash of each type, and CDR that was read and written again; None: there is no such type."""
    node, found = rclpy.create_node("types"), {}
    for number, (kind, payload) in enumerate(payloads.items()):
        try:
            made = class_of(kind)
        except ModuleNotFoundError:
            found[kind] = None
            continue
        node.create_publisher(made, f"/topic_{number}", 10)
        (publisher,) = node.get_publishers_info_by_topic(f"/topic_{number}")
        again = serialize_message(deserialize_message(bytes.fromhex(payload), made))
        found[kind] = [str(publisher.topic_type_hash), bytes(again).hex()]
    return found


def forward(kind, message):
    return (message.twist if kind.endswith("Stamped") else message).linear


def obeyed(kind):
    """Commands a robot until it is killed, once robot and watchdog listen."""
    made = class_of(kind)
    node, message = rclpy.create_node("commander", namespace="tb3_0"), made()
    forward(kind, message).x = 0.1
    publisher = node.create_publisher(made, "cmd_vel", 10)
    while publisher.get_subscription_count() < 2:
        time.sleep(PERIOD_S)
    while True:
        publisher.publish(message)
        time.sleep(PERIOD_S)


def drive(kind, watchdog):
    """A robot with a watchdog: its speeds [m/s] as commanders are killed and the watchdog is ended."""
    node, heard = rclpy.create_node(DRIVER, namespace="tb3_0"), []
    node.create_subscription(class_of(kind), "cmd_vel", lambda message: heard.append(forward(kind, message).x), 100)
    deadline, children = time.monotonic() + PATIENCE_S, []

    def start(*words):
        children.append(subprocess.Popen([sys.executable, *words], stdin=subprocess.DEVNULL, stdout=sys.stderr))
        return children[-1]

    def until(done):
        while not done():
            assert time.monotonic() < deadline, f"after {len(heard)} commands"
            rclpy.spin_once(node, timeout_sec=0.1)

    try:
        dog = start(watchdog, "--ros-args", "-r", "__ns:=/tb3_0")
        until(lambda: node.count_publishers("/tb3_0/cmd_vel") == 1)
        commander = start(__file__, "command", kind)
        until(lambda: heard.count(0.1) >= 20)
        del heard[: heard.index(0.1)]
        commander.kill()
        commander.wait()
        until(lambda: heard.count(0.0) >= 10)
        killed, heard[:] = heard[:], []
        start(__file__, "command", kind)
        until(lambda: len(heard) >= 20 and set(heard[-20:]) == {0.1})
        heard.clear()
        dog.terminate()
        ended = dog.wait(100.0)
        until(lambda: heard.count(0.1) >= 20)
    finally:
        for child in children:
            child.kill()
            child.wait()
    return {"killed": killed, "told": heard, "ended": ended}


if __name__ == "__main__":
    rclpy.init()
    what, *words = sys.argv[1:]
    print(json.dumps({"types": types, "drive": drive, "command": obeyed}[what](*words or [json.load(sys.stdin)])))
    rclpy.shutdown()
