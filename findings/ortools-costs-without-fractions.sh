#!/usr/bin/env bash
# ortools 9.15.6755: SimpleLinearSumAssignment cuts the fractions of costs that come as an array. Guess: TypeError, as for
# one arc with such a cost. Robots less than a metre from their goals have all the same cost, 0: each is sent to
# another's goal, 1.8 m of ways in place of 0.8 m, with the status OPTIMAL.
# Seen: one arc TypeError; array OPTIMAL, mates 0 and 1, cost 0
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet ortools==9.15.6755
cat > "$place/seen.py" <<'END'
import numpy as np
from ortools.graph.python.linear_sum_assignment import SimpleLinearSumAssignment

distance = np.array([[0.9, 0.4], [0.4, 0.9]])  # of two robots from two goals [m]
try:
    SimpleLinearSumAssignment().add_arc_with_cost(0, 1, 0.4)
    print("one arc: taken")
except TypeError:
    print("one arc: TypeError")
robots, goals = np.indices((2, 2))
assignment = SimpleLinearSumAssignment()
assignment.add_arcs_with_cost(robots.ravel(), goals.ravel(), distance.ravel())
status = assignment.solve().name
mates = [assignment.right_mate(robot) for robot in range(2)]
print(f"array: {status}, goals {mates}, cost {assignment.optimal_cost()}")
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "one arc: TypeError
array: OPTIMAL, goals [0, 1], cost 0" ] || { echo "the behaviour has changed" >&2; exit 1; }
