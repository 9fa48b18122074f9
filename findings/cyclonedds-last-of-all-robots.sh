#!/usr/bin/env bash
# cyclonedds 11.0.1: by default a reader keeps one sample of a topic: of poses that two robots publish on one topic
# without a key only the last pose of all is left, whatever take(N=...) asks for. Guess: some history, or one sample of
# each robot. With the name as the key it is one of each robot; Policy.History.KeepAll keeps
# all.
# Seen: of five poses of A and B each: no key [B 4], key [A 4, B 4], all 10
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet cyclonedds==11.0.1
cat > "$place/seen.py" <<'END'
import os
import time
from dataclasses import dataclass

os.environ["CYCLONEDDS_URI"] = """<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast>
<Interfaces><NetworkInterface name="lo"/></Interfaces></General></Domain></CycloneDDS>"""

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import key
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic


@dataclass
class Plain(IdlStruct, typename="Plain"):
    robot: str
    number: int


@dataclass
class Keyed(IdlStruct, typename="Keyed"):
    robot: str
    key("robot")
    number: int


everything = Qos(Policy.Reliability.Reliable(1_000_000_000), Policy.History.KeepAll)
participant = DomainParticipant()
for name, kind, quality in (("no key", Plain, None), ("key", Keyed, None), ("keep all", Plain, everything)):
    topic = Topic(participant, name.replace(" ", "_"), kind)
    reader, writer = DataReader(participant, topic, qos=quality), DataWriter(participant, topic, qos=quality)
    for number in range(5):
        for robot in "AB":
            writer.write(kind(robot, number))
    time.sleep(0.5)
    taken = reader.take(N=100)
    print(name, len(taken), *(f"{each.robot}{each.number}" for each in taken[-2:]))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "no key 1 B4
key 2 A4 B4
keep all 10 A4 B4" ] || { echo "the behaviour has changed" >&2; exit 1; }
