"""Watchdog of a TurtleBot3: a ROS 2 node on the robot that stops it when no commands come.

turtlebot3_node drives on with the last cmd_vel for ever. This file is copied to the robot as it is (`./zenpark hosts
watchdog`), and needs Python 3.10 and the rclpy of ROS 2 Humble or later there, nothing of zenpark.

    python3 watchdog.py [--silence 0.5] [--topic cmd_vel] [--type auto|twist|stamped] [--ros-args -r __ns:=/tb3_0]
"""

# ruff: noqa: ANN401 - rclpy and its messages have no types here

import argparse
import importlib
import os
import signal
import sys
import time
from typing import Any

CHECK_S = 0.02  # pause between two looks at the clock
ZERO_S = 0.05  # pause between two zeros
ZEROS_S = 1.0  # time for which zeros are repeated: one may be lost
GRAPH_S = 1.0  # pause between two looks for the type that the robot takes
TYPES = {"twist": "geometry_msgs/msg/Twist", "stamped": "geometry_msgs/msg/TwistStamped"}


class StopTimer:
    """Decision when zeros are due. Times in seconds on any one clock that never steps."""

    def __init__(self, silence_s: float, begin: float) -> None:
        """`begin`: time now; the robot may be driving by a command from before."""
        self._silence_s, self._heard = silence_s, begin
        self._stopped_at = self._zero_at = -1e9
        self._moves = True  # the last command was no zero
        self.stops = 0  # times that the robot was stopped

    def hear(self, t: float, *, moves: bool) -> None:
        """Note a command received at `t`; our own zeros arrive as well, and change nothing."""
        self._heard, self._moves = t, moves

    def zero_due(self, t: float) -> bool:
        """Whether a zero must be sent at `t`; the caller sends it."""
        if self._moves and t - self._heard > self._silence_s:
            self._moves, self._stopped_at = False, t
            self.stops += 1
        elif self._moves or t - self._stopped_at > ZEROS_S:
            return False
        if t - self._zero_at < ZERO_S:
            return False
        self._zero_at = t
        return True


def moving(twist: Any) -> bool:
    """Whether a Twist asks for motion; one that is not a number does."""
    linear, angular = twist.linear, twist.angular
    return any(value != 0.0 for v in (linear, angular) for value in (v.x, v.y, v.z))


def type_of_robot(node: Any, topic: str) -> str:
    """Type of the topic at its subscribers on the robot, other than this node; "" if there are none."""
    for each in node.get_subscriptions_info_by_topic(topic):
        if each.node_name != node.get_name() and each.topic_type in TYPES.values():
            return str(each.topic_type)
    return ""


class WatchdogNode:
    """The node: commands in, zeros out."""

    def __init__(self, rclpy: Any, topic: str, kind: str, silence_s: float) -> None:
        messages = importlib.import_module("geometry_msgs.msg")
        self.node = rclpy.create_node("cmd_vel_watchdog")
        self.watchdog = StopTimer(silence_s, time.monotonic())
        self._make = messages.TwistStamped if kind == TYPES["stamped"] else messages.Twist
        self._stamped = kind == TYPES["stamped"]
        self._publisher = self.node.create_publisher(self._make, topic, 10)
        self.node.create_subscription(self._make, topic, self._receive, 10)
        self.node.create_timer(CHECK_S, self._check)
        self.node.get_logger().info(
            f"watches {topic} ({kind}): stops the robot after {silence_s:g} s without a command"
        )

    def _receive(self, message: Any) -> None:
        self.watchdog.hear(time.monotonic(), moves=moving(message.twist if self._stamped else message))

    def _check(self) -> None:
        before = self.watchdog.stops
        if self.watchdog.zero_due(time.monotonic()):
            message = self._make()
            if self._stamped:
                message.header.stamp = self.node.get_clock().now().to_msg()
            self._publisher.publish(message)
        if self.watchdog.stops > before:
            self.node.get_logger().warning("no command: the robot is stopped")

    def stop(self) -> None:
        """Stop a robot that moves, before the node ends: with its writer, DDS drops what the robot has not read yet."""
        self.watchdog.hear(-1e9, moves=True)
        until = time.monotonic() + ZEROS_S
        while time.monotonic() < until:
            self._check()
            time.sleep(CHECK_S)


def wait_for_type(rclpy: Any, topic: str) -> str:
    """Type of the topic that the robot takes; by its distribution if it does not come up in ten seconds."""
    node = rclpy.create_node("cmd_vel_watchdog_looks")
    try:
        for _ in range(10):
            rclpy.spin_once(node, timeout_sec=GRAPH_S)
            if found := type_of_robot(node, topic):
                return found
    finally:
        node.destroy_node()
    return TYPES["twist" if os.environ.get("ROS_DISTRO", "humble") <= "humble" else "stamped"]


def main(words: "list[str]") -> int:
    """Run the node until it is asked to end."""
    parser = argparse.ArgumentParser(description="Stops a TurtleBot3 that gets no commands.")
    parser.add_argument("--silence", type=float, default=0.5, help="[s] without a command after which it is stopped")
    parser.add_argument("--topic", default="cmd_vel")
    parser.add_argument(
        "--type", choices=("auto", *TYPES), default="auto", help="of the topic; auto: as the robot takes"
    )
    rclpy = importlib.import_module("rclpy")
    asked = parser.parse_args(importlib.import_module("rclpy.utilities").remove_ros_args(args=["watchdog", *words])[1:])
    # the handlers of rclpy would end the context at once: no zero could be sent any more
    own = importlib.import_module("rclpy.signals").SignalHandlerOptions.NO
    rclpy.init(args=["watchdog", *words], signal_handler_options=own)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    node = None
    try:
        kind = wait_for_type(rclpy, asked.topic) if asked.type == "auto" else TYPES[asked.type]
        node = WatchdogNode(rclpy, asked.topic, kind, asked.silence)
        rclpy.spin(node.node)
    except KeyboardInterrupt:
        return 0
    finally:
        if rclpy.ok():
            if node is not None:
                node.stop()
            rclpy.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
