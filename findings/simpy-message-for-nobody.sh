#!/usr/bin/env bash
# simpy 4.1.2: the get of a Store that lost a race against a timeout goes on waiting, and takes the next item away. Guess: the
# event of a race that is over is given up. A robot that waits for a message for a second at a time, in a simulated
# network, never sees the first message after a silence, and nothing is left in the store.
# Seen: after 1 s nothing; after 1.5 s "b", although "a" was put first; the store is empty
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet simpy==4.1.2
cat > "$place/seen.py" <<'END'
import simpy

world = simpy.Environment()
inbox = simpy.Store(world)


def robot():
    for _ in range(2):
        message = inbox.get()
        yield message | world.timeout(1.0)
        print(f"{world.now} s: {message.value if message.triggered else 'nothing'}")


def neighbour():
    yield world.timeout(1.5)
    yield inbox.put("a")
    yield inbox.put("b")


world.process(robot())
world.process(neighbour())
world.run()
print(f"left: {inbox.items}")
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "1.0 s: nothing
1.5 s: b
left: []" ] || { echo "the behaviour has changed" >&2; exit 1; }
