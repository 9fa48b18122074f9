"""Experiment files in the structure of Robotic Park's authors, made here; nothing of theirs is in them."""

import numpy as np

from experiments.authoring import layouts

SECTIONS = """# an experiment in the structure of Robotic Park
Operation:
  mode: {mode}     # physical, virtual, hybrid
  tool: Webots
  world: empty.wbt
Experience: {{type: formation}}
Architecture: {{mode: {architecture}, node: {{executable: none, name: none, pkg: none}}}}
CPU_Monitoring: {{enable: False}}
Interface: {{enable: False}}
Data_Logging: {{enable: {logging}, topics: /dron01/local_pose}}
Robots:
"""
ROBOT = """  Robot{number:02d}:
    type: {place}
    name: {name}
    control_mode: HighLevel
    positioning: {positioning}
    pose: {pose}
    {address}
    controller: {{type: pid, enable: True, protocol: Continuous, period: 0.01, threshold: {{type: Constant, co: 0.01}}}}
    communication:
      type: {speaks}
      threshold:
        type: Constant
        co: {threshold}
        ai: 0.0
    local_pose: {{enable: True, path: False, T: {pose_ms}}}
    task:
      enable: {task}
      T: 100
      Onboard: True
      controller:
        type: {law}
        protocol: {protocol}
        period: 0.1
        upperLimit: 0.1
        lowerLimit: -0.1
        gain: {gain}
        threshold: {{type: Constant, co: 0.005, ai: 0.1}}
      role: consensus
      type: {kind}
      relationship: {relationship}

"""
TAIL = "Supervisor: {enable: False}\nOther:\n"
USUAL = {
    "place": "virtual", "kind": "distance", "positioning": "Intern", "speaks": "EventBased", "threshold": 0.01,
    "pose_ms": 20, "law": "gradient", "protocol": "Continuous", "gain": 0.25,
}  # fmt: skip


def robot(number, name, pose, relations, **more):
    """One of their robots, as text."""
    address = f"uri: radio://0/80/2M/E7E7E7E7{number:02d}"
    if name.startswith("khepera"):
        address = f"agent_ip: 192.168.0.{20 + number}\n    port_number: 50000"
    given = {
        "number": number,
        "name": name,
        "pose": ", ".join(f"{value:.2f}" for value in pose),
        "relationship": ", ".join(relations) or "none_1.0",
        "task": bool(relations),
        "address": address,
    }
    return ROBOT.format(**{**USUAL, **given, **more})


def file(robots, mode="virtual", architecture="distributed", logging="False"):
    """An experiment of theirs, as text."""
    return SECTIONS.format(mode=mode, architecture=architecture, logging=logging) + "".join(robots) + TAIL


def drones(place, starts, links, *, extra=(), real=(), **more):
    """Drones that keep their distances in a shape; `links` are pairs of rows, `extra` relations of each."""
    names = [f"dron{number:02d}" for number in range(1, len(place) + 1)]
    robots = []
    for row, name in enumerate(names):
        others = [sum(pair) - row for pair in links if row in pair]
        relations = [f"{names[j]}_{np.linalg.norm(place[row] - place[j]):.4f}" for j in others]
        where = {"place": "physical"} if row in real else {}
        robots.append(robot(row + 1, name, starts[row], [*relations, *extra], **{**more, **where}))
    return file(robots, "hybrid" if real else "virtual")


def dome(count, *, origin=False, **more):
    """Drones that spread over a dome, all from one height, their starts a third farther out than their places."""
    made = layouts.hemisphere(count, 0.6, 0.25)
    place = made.position
    last = 1.0 - (count - 0.5) / count * (1.0 - layouts.RIM)  # cosine of the lowest one's angle from the top
    radius = np.linalg.norm(place[-1, :2]) / np.sqrt(1.0 - last**2)
    extra = [f"origin_{radius:.4f}"] if origin else []
    starts = [(1.3 * x, 1.3 * y, 0.7) for x, y, _ in place]
    return drones(place, starts, made.pairs.tolist(), extra=extra, **more)


def column(count, drones=0, *, real=(), **more):
    """Robots in two rows behind a first one, each by its place behind two before it; the last of them drones."""
    flies = [k >= count - drones for k in range(count)]
    place = [(-0.4 * (k // 2), 0.5 * (k % 2), 0.7 if flies[k] else 0.0) for k in range(count)]
    names = [f"dron{k:02d}" if flies[k] else f"khepera{k:02d}" for k in range(count)]
    robots = []
    for k, name in enumerate(names):
        relations = []
        for j in range(k - 1, max(k - 3, -1), -1):
            offset = "_".join(f"{a - b:.2f}" for a, b in zip(place[k], place[j], strict=True))
            relations.append(f"{names[j]}_{offset}")
        x, y, z = place[k]
        start = (x + 0.1 * (k % 3 - 1) + 1.5, 1.4 * (y - 0.25), z)
        where = "digital_twin" if k in real else "virtual"
        robots.append(robot(k + 1, name, start, relations, place=where, kind="pose", law="pid", **more))
    return file(robots, "hybrid" if real else "virtual")


FLAT = """{name}:
  {naming}: {name}
  {address}
  controller_type: PID_Continuous
  communication: {{type: {speaks}, threshold: {{type: Constant, co: 0.02, ai: Null}}}}
  task: {{enable: True, T: 200, Onboard: False, role: consensus, type: distance, relationship: '{relations}'}}
"""
OTHERS = {
    "dron01": ("khepera01", "khepera02"),
    "khepera01": ("dron01", "khepera02"),
    "khepera02": ("dron01", "khepera01"),
}


def flat(name, **changed):
    """Robot of a file of 2023, as text: a triangle of 0.8 m with a drone 0.7 m above its base."""
    wheels = name.startswith("khepera")
    address = f"agent_ip: '192.168.0.{name[-1]}'\n  port_number: 50000\n  init_theta: -1.5"
    given = {
        "name": name,
        "naming": "id" if wheels else "name",
        "address": address if wheels else "control_mode: HighLevel",
        "speaks": "EvenBased",
        "relations": ", ".join(f"{other}_{0.8 if wheels and other[0] == 'k' else 0.9}" for other in OTHERS[name]),
    }
    return FLAT.format(**{**given, **changed})
