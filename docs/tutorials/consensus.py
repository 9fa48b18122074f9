# %% [markdown]
# # Consensus and the Laplacian
#
# Six drones are to meet. Each receives the poses of some of the others, and flies a little toward these neighbours.
# Do they meet, where, and how soon? One matrix answers before anything moves: the Laplacian of the graph of links.
#
# The lesson computes the answer, has six simulated drones fly it, and compares. Every claim below stands beside an
# `assert` of it. You need eigenvalues and first-order differential equations, and about an hour.

# %%
from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from zenpark import (
    KINDS,
    Array,
    Document,
    Trace,
    check,
    figures,
    folder,
    formation,
    graph,
    loads,
    show,
    simulate,
    style,
)  # fmt: skip

OUT = folder("docs/tutorials/out")
TELLO = KINDS["tello"]
N = 6

# %% [markdown]
# ## 1. Graphs, and their Laplacian
#
# A graph is its edges. Here both ends of an edge receive from each other, so the graph has no direction.

# %%
Pairs = list[tuple[int, int]]
GRAPHS: dict[str, Pairs] = {
    "path": [(i, i + 1) for i in range(N - 1)],
    "ring": [(i, (i + 1) % N) for i in range(N)],
    "star": [(0, i) for i in range(1, N)],
    "complete": [(i, j) for i in range(N) for j in range(i)],
}


def laplacian_of(pairs: Pairs) -> Array:
    """L = D − A of the graph in which both ends of every pair receive from each other."""
    net = graph.links([*pairs, *((j, i) for i, j in pairs)])
    return graph.degree(net, N) - graph.adjacency(net, N)


print(laplacian_of(GRAPHS["path"]))

# %% [markdown]
# On the diagonal is a robot's number of neighbours; off it, −1 for each. So every row adds up to zero: L times a
# vector of equal numbers is zero, and 0 is always an eigenvalue, λ₁. Without directions L is symmetric, the
# eigenvalues are real and none is negative. The next one, λ₂, is the *algebraic connectivity* (Fiedler, 1973): it
# is zero if and only if the graph falls into parts. For some graphs the eigenvalues are known in closed form.

# %%
KNOWN = {
    "path": 2.0 - 2.0 * np.cos(np.pi / N),
    "ring": 2.0 - 2.0 * np.cos(2.0 * np.pi / N),
    "star": 1.0,
    "complete": float(N),
}
for name, pairs in GRAPHS.items():
    L = laplacian_of(pairs)
    eigenvalues = np.linalg.eigvalsh(L)
    assert np.all(L.sum(axis=1) == 0.0)
    assert abs(eigenvalues[0]) < 1e-12
    assert abs(eigenvalues[1] - KNOWN[name]) < 1e-12
    print(f"{name:>9}: {len(pairs):2d} edges, eigenvalues {np.round(eigenvalues, 3) + 0.0}")

# %% [markdown]
# Two triangles without a link between them: the eigenvalue 0 comes twice, once for each part.

# %%
two_triangles: Pairs = [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3)]
eigenvalues = np.linalg.eigvalsh(laplacian_of(two_triangles))
assert graph.components(graph.links(two_triangles), N) == 2
assert (np.abs(eigenvalues) < 1e-12).sum() == 2


# %%
@style.styled
def spectra() -> Figure:
    """Each graph on a circle, and its eigenvalues below."""
    figure = style.Drawing(figsize=(2.0 * style.WIDTH, 2.7), layout="constrained")
    panels = figure.subplots(2, len(GRAPHS), height_ratios=(2.0, 1.0))
    angle = 2.0 * np.pi * np.arange(N) / N
    x, y = np.cos(angle), np.sin(angle)
    for k, (name, pairs) in enumerate(GRAPHS.items()):
        above, below = panels[:, k]
        for i, j in pairs:
            above.plot(x[[i, j]], y[[i, j]], color="#9a9a9a", zorder=1)
        above.scatter(x, y, s=60, color=style.CASES[k], zorder=2)
        above.set(title=name, aspect="equal", xlim=(-1.3, 1.3), ylim=(-1.3, 1.3))
        above.axis("off")
        values = np.linalg.eigvalsh(laplacian_of(pairs))
        below.plot(values, np.zeros(N), "o", color=style.CASES[k], alpha=0.6, clip_on=False)
        below.plot(values[1], 0.0, "o", markersize=10, fillstyle="none", color=style.MAGENTA)
        below.set(xlim=(-0.4, 6.4), ylim=(-1.0, 1.0), yticks=[], xlabel=r"$\lambda$; circled: $\lambda_2$")
        below.spines["left"].set_visible(False)
    return figure


show(spectra(), OUT / "consensus-spectra")

# %% [markdown]
# ## 2. The experiment
#
# The law `displacement` moves the goal of robot i by uᵢ = −k Σⱼ (xᵢ − xⱼ − dᵢⱼ) over its neighbours j.
# With all offsets dᵢⱼ = 0 that is −k times row i of L x: consensus. k is the `stiffness`, the share of a difference
# that one decision takes; there are ten decisions in a second.
#
# All meet in one point of the plane, so each drone holds a height of its own, 0.4 m above the next. What happens
# along z is no part of the law. The network is perfect, and no drone wobbles: the motion shows the law and the
# drones' own dynamics.

# %%
START = [(-1.0, 0.6), (-0.4, -0.9), (0.9, -0.5), (0.2, 1.0), (1.1, 0.7), (-0.8, -0.2)]  # x, y [m]


def rendezvous(pairs: Pairs, stiffness: float, duration_s: float) -> Document:
    """An experiment: consensus of six drones on where to meet."""
    robots = [
        f'D{i} = {{ kind = "tello", start = [{x}, {y}], hover = {0.5 + 0.4 * i:.1f} }}'
        for i, (x, y) in enumerate(START)
    ]
    wanted = [f'"D{i} - D{j}" = {{ offset = [0.0, 0.0] }}' for i, j in pairs]
    return loads(
        "\n".join(
            [
                f'title = "Six drones meet"\nduration_s = {duration_s}',
                'trigger = { kind = "periodic", period_s = 0.02 }',
                "[arena]\nsize = [6.0, 6.0, 3.0]",
                f'[formation]\nlaw = "displacement"\nstiffness = {stiffness}\nclamp = 1.0',
                "[robots]",
                *robots,
                "[formation.links]",
                *wanted,
            ]
        )
    )


GAIN, DURATION_S = 0.06, 40.0
experiments = {name: rendezvous(pairs, GAIN, DURATION_S) for name, pairs in GRAPHS.items()}
print("\n".join(str(finding) for finding in check(experiments["ring"])))

# %% [markdown]
# `check` finds: the network is whole and has no leader, the sampled loop is stable. It warns that drones would
# land on each other, and it is right. Meeting is a law for a lesson and for particles; robots have a size and take
# offsets that are not zero. Nothing below changes with them, see exercise 1.

# %%
codes = {finding.code for finding in check(experiments["ring"]) if finding.severity != "note"}
assert codes == {"lands-on", "not-acquired", "not-random"}  # nothing here is random: one seed is enough

# %% [markdown]
# Now they fly, in virtual time: the same code that would run in each robot's process, at the speed of this machine.

# %%
runs = {name: simulate(document).traces["default"] for name, document in experiments.items()}


@style.styled
def motions() -> Figure:
    """x of all robots, for each graph."""
    figure = style.Drawing(figsize=(2.0 * style.WIDTH, 1.7), layout="constrained")
    for k, (axes, (name, trace)) in enumerate(
        zip(figure.subplots(1, len(runs), sharex=True, sharey=True), runs.items(), strict=True)
    ):
        axes.plot(trace.time, trace.true_position[..., 0], color=style.CASES[k], linewidth=0.7)
        axes.axhline(np.mean(START, axis=0)[0], color=style.MAGENTA, linestyle="--", linewidth=0.8)
        axes.set(title=name, xlabel="$t$ [s]", xlim=(0.0, DURATION_S))
        if k == 0:
            axes.set_ylabel("$x$ [m]")
    return figure


show(motions(), OUT / "consensus-motions")

# %% [markdown]
# *Where* do they meet? L is symmetric, so 1ᵀ L = 0: the law moves the sum of all x by nothing, and the meeting
# place can only be the mean of the starts, the dashed line, whatever the graph. (A message takes 20 ms at most
# until it is received; that costs less than a millimetre.)

# %%
for name, trace in runs.items():
    centroid = trace.true_position[..., :2].mean(axis=1)
    drift = float(np.abs(centroid - np.mean(START, axis=0)).max())
    print(f"{name:>9}: the centroid moved by {1e3 * drift:.2f} mm")
    assert drift < 1e-3

# %% [markdown]
# ## 3. How fast: the rate predicted
#
# Write x in the eigenvectors of L: x = Σ zᵢ vᵢ. The modes do not act on each other. *First prediction*, with
# robots that close a distance to their goal at the rate c (`response`, 1 per second for a Tello): żᵢ = −c k λᵢ
# zᵢ. Every mode decays at its own rate c k λᵢ; the slowest is that of λ₂, so **the algebraic connectivity is the
# rate of convergence**.
#
# We can measure each mode alone: project the true positions onto its eigenvector, and fit a line to the logarithm.

# %%
ABOVE, SETTLED_S = 0.02, 2.0  # a mode is measured while it is above 2 % of its beginning, and not while it sets off


def decay_rates(trace: Trace, modes: Array) -> Array:
    """Rate (N − 1,) at which each mode but the first, the columns of `modes`, decays in a run [1/s]."""
    along = np.einsum("nm,tnc->tmc", modes, trace.true_position[..., :2])
    size = np.linalg.norm(along, axis=2)
    found = []
    for mode in range(1, N):
        gone = size[:, mode] < ABOVE * size[0, mode]
        end = trace.time[gone.argmax()] if gone.any() else np.inf
        use = (trace.time > SETTLED_S) & (trace.time < end)
        found.append(-np.polyfit(trace.time[use], np.log(size[use, mode]), 1)[0])
    return np.array(found)


spectrum = {name: np.linalg.eigh(laplacian_of(pairs)) for name, pairs in GRAPHS.items()}
eigenvalue = np.concatenate([values[1:] for values, _ in spectrum.values()])
measured = np.concatenate([decay_rates(runs[name], modes) for name, (_, modes) in spectrum.items()])
by_hand = TELLO.response * GAIN * eigenvalue
off = measured / by_hand - 1.0
print(f"{len(measured)} modes, measured over predicted: {off.min():+.1%} to {off.max():+.1%}")
assert np.all(np.abs(off) < 0.125)

# %% [markdown]
# A prediction by hand, over a range of rates of more than 20, and no mode is off by more than an eighth. But the
# errors are no accident: slow modes are slower than predicted, and fast ones faster. Both have a reason.
#
# *Sampling.* The goal is decided again ten times in a second, and stands in between. Of a distance to its goal a
# robot then closes h = 1 − exp(−c/10), and a decision leaves 1 − h k λ of a mode. That is what `check` computes;
# its `slowest_mode_s` is the time constant of λ₂.
#
# *Lag.* A quadrotor must get up to speed first: its velocity follows what its position controller wants at the rate
# k_v = 3 per second. So it has two states, and a decision is a 2 × 2 matrix; its larger eigenvalue is what is
# left.

# %%
HZ = 10.0  # decisions in a second
BODY_HZ = 100.0  # steps of the position controller
h = float(formation.closed_shares([TELLO], HZ)[0])


def sampled_rate(taken: float) -> float:
    """Rate of a mode of which k λ is `taken` per decision, for robots of one state [1/s]."""
    return -HZ * float(np.log(1.0 - h * taken))


def lagging_rate(taken: float) -> float:
    """The same for robots of two states, distance to the meeting place and velocity [1/s]."""
    k_p, k_v, dt = TELLO.response, 1.0 / TELLO.lag, 1.0 / BODY_HZ
    after = np.eye(2)  # columns: what becomes of a unit of either state
    goal = (1.0 - taken) * after[0]
    for _ in range(round(BODY_HZ / HZ)):
        after[1] += dt * k_v * (k_p * (goal - after[0]) - after[1])
        after[0] += dt * after[1]
    return -HZ * float(np.log(np.abs(np.linalg.eigvals(after)).max()))


for name, document in experiments.items():
    found = figures(document.cases()["default"])
    slowest_s = found.slowest_mode_s
    assert abs(found.algebraic_connectivity - KNOWN[name]) < 1e-12
    assert slowest_s is not None
    assert abs(slowest_s * sampled_rate(GAIN * KNOWN[name]) - 1.0) < 1e-3
    print(f"{name:>9}: check says that the slowest mode takes {slowest_s:.1f} s")

sampled = np.array([sampled_rate(GAIN * value) for value in eigenvalue])
lagging = np.array([lagging_rate(GAIN * value) for value in eigenvalue])
print(f"sampled:        {(measured / sampled - 1.0).min():+.1%} to {(measured / sampled - 1.0).max():+.1%}")
print(f"sampled, a lag: {(measured / lagging - 1.0).min():+.1%} to {(measured / lagging - 1.0).max():+.1%}")
assert np.all(np.abs(measured / sampled - 1.0) < 0.16)
assert np.all(np.abs(measured / lagging - 1.0) < 0.005)

# %% [markdown]
# With both, twenty modes of four graphs are predicted to half a percent. Sampling alone explains why slow modes are
# slower; it does worse than our guess by hand for fast ones, where two errors happened to cancel. That is worth
# remembering: a better model of one thing need not be a better model.


# %%
@style.styled
def rates() -> Figure:
    """Measured rates over the eigenvalue, and how far the predictions are off."""
    figure = style.Drawing(figsize=(2.0 * style.WIDTH, 2.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    line = np.linspace(0.0, 6.2, 100)
    left.plot(line, TELLO.response * GAIN * line, color=style.MAGENTA, label=r"$c\,k\,\lambda$", zorder=1)
    for k, name in enumerate(GRAPHS):
        mine = slice(k * (N - 1), (k + 1) * (N - 1))
        left.plot(eigenvalue[mine], measured[mine], "o^sD"[k], color=style.CASES[k], fillstyle="none", label=name)
    left.set(xlabel=r"eigenvalue $\lambda$", ylabel="measured rate [1/s]", xlim=(0.0, 6.3), ylim=(0.0, None))
    left.legend()
    for name, predicted, marker, colour in (
        ("by hand", by_hand, "o", style.CASES[0]),
        ("sampled", sampled, "s", style.CASES[1]),
        ("sampled, with lag", lagging, "^", style.CASES[2]),
    ):
        right.plot(eigenvalue, 100.0 * (measured / predicted - 1.0), marker, color=colour, fillstyle="none", label=name)
    right.axhline(0.0, color="#9a9a9a", linewidth=0.6)
    right.set(xlabel=r"eigenvalue $\lambda$", ylabel="measured over predicted [%]", xlim=(0.0, 6.3))
    right.legend()
    return figure


show(rates(), OUT / "consensus-rates")

# %% [markdown]
# ## 4. How large may a step be?
#
# A larger k makes all modes faster, until a decision overshoots: 1 − h k λ is negative from h k λ = 1 on, and below
# −1 from **h k λ_max = 2** on. So the largest eigenvalue of L limits the step, and the smallest but one the rate;
# the best that any k can do depends on λ_max/λ₂ alone. `check` refuses what lies beyond 2. It warns from 1.2 on,
# because it leaves room for what its model does not have. Is that room needed? With the lag of section 3 a drone
# bears a factor of its own, and h is 2 over that factor here, which `check` computes likewise.

# %%
largest = float(spectrum["ring"][0][-1])
h = 2.0 / float(formation.bearable_factors([TELLO], HZ)[0])
print(f"the limit of the ring: k = 2/(h λ_max) = {2.0 / (h * largest):.2f} per decision")
LOOP = (0.4, 0.8, 1.1, 1.5, 1.8, 2.1, 2.5)  # h k λ_max
left_over, said, steps = [], [], {}
for loop in LOOP:
    document = rendezvous(GRAPHS["ring"], loop / (h * largest), 20.0)
    gain = figures(document.cases()["default"]).loop_gain
    assert gain is not None
    assert abs(gain - loop) < 1e-3
    said.append({finding.code for finding in check(document)} & {"stable", "oscillates", "unstable"})
    trace = simulate(document).traces["default"]
    away = trace.true_position[..., :2] - trace.true_position[..., :2].mean(axis=1, keepdims=True)
    distance = np.linalg.norm(away, axis=2).max(axis=1)
    left_over.append(float(distance[trace.time > 15.0].max()))
    steps[loop] = trace
    print(f"h k λ_max = {loop}: {1e3 * left_over[-1]:9.5f} mm are left after 15 s; check says {said[-1].copy().pop()}")

assert said == [{"stable"}] * 3 + [{"oscillates"}] * 2 + [{"unstable"}] * 2
assert max(left_over[:3]) < 1e-4  # they meet
assert left_over[3] < 0.01  # they still do, but take long
assert min(left_over[5:]) > 0.03  # they never do
assert left_over[:5] == sorted(left_over[:5])

# %% [markdown]
# Beyond the limit they do not fly away, as the linear model says they would: speed limits turn the growth into a
# dance that never ends, in which neighbours on the ring swap sides (the eigenvector of λ_max has alternating
# signs). Just below the limit everything still settles, with a lag, a delay of a message and all; it only takes
# longer and longer. The room between 1.2 and 2 is for that. And the meeting place is no longer the mean of the
# starts: a goal that is cut off knows nothing of 1ᵀ L = 0.


# %%
@style.styled
def step_sizes() -> Figure:
    """The approach below and beyond the limit, and what is left."""
    figure = style.Drawing(figsize=(2.0 * style.WIDTH, 2.0), layout="constrained")
    panels = figure.subplots(1, 4, width_ratios=(1.0, 1.0, 1.0, 1.3))
    for axes, loop, colour in zip(panels, (0.4, 1.8, 2.5), style.CASES, strict=False):
        axes.plot(steps[loop].time, steps[loop].true_position[..., 0], color=colour, linewidth=0.6)
        axes.set(title=rf"$h k \lambda_{{max}} = {loop}$", xlabel="$t$ [s]", xlim=(0.0, 10.0), ylim=(-1.2, 1.2))
    panels[0].set_ylabel("$x$ [m]")
    panels[3].semilogy(LOOP, left_over, "o-", color=style.CASES[3])
    for at in (1.2, 2.0):
        panels[3].axvline(at, color=style.MAGENTA, linestyle="--", linewidth=0.8)
    panels[3].set(xlabel=r"$h k \lambda_{max}$", ylabel="left after 15 s [m]")
    return figure


show(step_sizes(), OUT / "consensus-steps")

# %% [markdown]
# ## Exercises
#
# 1. Give the links the offsets of a hexagon of 0.6 m instead of zeros. Show that with y = x − (its corners) nothing
#    in section 3 changes, and measure the rates again. Which warnings of `check` are gone?
# 2. Let D0 receive from no robot (`"D0 > D1"` instead of `"D0 - D1"`), in the path and in the star. L is not
#    symmetric now: where do they meet, and why? Delete row and column of D0 from L: its smallest eigenvalue is the
#    new rate. Predict it, then run.
# 3. You may place one more edge in the path of six. Which one makes λ₂ largest? Try all ten by eigenvalues, then
#    fly the best and the worst.
