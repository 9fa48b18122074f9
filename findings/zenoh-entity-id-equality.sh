#!/usr/bin/env bash
# eclipse-zenoh 1.10.2, Python: the id of a publisher (EntityGlobalId), asked for twice, is not equal to itself, and a set
# or dictionary keeps both. ZenohId, the id of a session, compares by value. Guess: both are values.
# Whoever counts numbers per source (sample.source_info.source_id) must use str(id) as the key.
# Seen: same text True equal False in a set 2 / session's id: equal True in a set 1
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet eclipse-zenoh==1.10.2
cat > "$place/seen.py" <<'END'
import zenoh

zenoh.init_log_from_env_or("error")
settings = zenoh.Config()
settings.insert_json5("scouting/multicast/enabled", "false")
settings.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
with zenoh.open(settings) as session, session.declare_publisher("a/b") as publisher:
    first, second = publisher.id, publisher.id
    print("same text", str(first) == str(second), "equal", first == second, "in a set", len({first, second}))
    print("session's id: equal", session.zid() == session.zid(), "in a set", len({session.zid(), session.zid()}))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "same text True equal False in a set 2
session's id: equal True in a set 1" ] || { echo "the behaviour has changed" >&2; exit 1; }
