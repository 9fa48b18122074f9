"""Arena files: what they say, what the experiment changes, and where they are wrong."""

import pytest

from experiments.catalogue import index
from experiments.file import catalogue as entries
from experiments.file import document
from experiments.file.document import DocumentError, read
from twins.scene import Obstacle

LAB = """# A lab
[arena]
size = [4.0, 3.0, 2.0]
walls = false

[arena.obstacles.post]
radius = 0.1
at = [1.0, 0.0]

[arena.obstacles.cart]
box = [0.3, 0.2]
at = [0.0, 1.0]
plan = { kind = "line", move_by = [1.0, 0.0], speed = 0.1 }

[arena.starts.west]
at = [-1.5, 0.0]
size = [0.9, 1.0]
"""
ONE = """title = "One"
duration_s = 20.0
[arena]
file = "lab.toml"
[robots.KH01]
kind = "khepera4"
start = [-1.5, 0.0]
"""


def write_files(folder, experiment=ONE, arena=LAB):
    (folder / "lab.toml").write_text(arena)
    (folder / "one.toml").write_text(experiment)
    return folder / "one.toml"


def refused(file, *changes):
    with pytest.raises(DocumentError) as caught:
        read(file, changes)
    return caught.value.problems


def test_arena_is_that_of_the_file(tmp_path):
    given = read(write_files(tmp_path))
    arena = given.experiment.arena
    assert arena.size == (4.0, 3.0, 2.0)
    assert not arena.walls
    assert arena.obstacles["post"] == Obstacle(radius=0.1, at=(1.0, 0.0))
    assert arena.starts["west"].size == (0.9, 1.0)
    assert arena.file is None
    assert given.listing.startswith(ONE)
    assert LAB in given.listing
    kept = tmp_path / "run"
    kept.mkdir()
    given.keep(kept / "experiment.toml")
    assert read(kept / "experiment.toml").experiment == given.experiment
    file = kept / "case.json"  # what processes read: there is no lab.toml
    file.write_bytes(document.write_json(given.plan))
    assert read(file).experiment == given.experiment


def test_own_keys_win_and_obstacles_merge_by_name(tmp_path):
    own = "walls = true\n[arena.obstacles.post]\nheight = 0.5\n[arena.obstacles.cart]\nradius = 0.2\n"
    own += "[arena.starts.east]\nat = [1.5, 0.0]\nsize = [0.5, 0.5]\n"
    arena = read(write_files(tmp_path, ONE.replace('"lab.toml"\n', f'"lab.toml"\n{own}'))).experiment.arena
    assert arena.walls
    assert arena.size == (4.0, 3.0, 2.0)
    assert arena.obstacles["post"] == Obstacle(radius=0.1, at=(1.0, 0.0), height=0.5)
    cart = arena.obstacles["cart"]  # another shape in place of the old one; the rest stays
    assert (cart.box, cart.radius, cart.at) == (None, 0.2, (0.0, 1.0))
    assert list(arena.starts) == ["west", "east"]


def test_case_changes_the_arena_or_takes_another_file(tmp_path):
    (tmp_path / "hall.toml").write_text("[arena]\nsize = [9.0, 9.0, 3.0]\n[arena.obstacles.pillar]\nradius = 0.4\n")
    cases = '[cases.lab.arena.obstacles.post]\nradius = 0.2\n[cases.hall.arena]\nfile = "hall.toml"\n'
    given = read(write_files(tmp_path, ONE + cases))
    found = {name: plan.experiment.arena for name, plan in given.cases().items()}
    assert found["lab"].obstacles["post"].radius == 0.2
    assert list(found["hall"].obstacles) == ["pillar"]
    assert found["hall"].size == (9.0, 9.0, 3.0)
    assert given.experiment.arena.obstacles["post"].radius == 0.1
    files = {name: file.name for name, file in given.source.arenas.items()}
    assert files == {"": "lab.toml", "lab": "lab.toml", "hall": "hall.toml"}


def test_command_line_changes_find_what_the_file_holds(tmp_path):
    file = write_files(tmp_path)
    found = read(file, ["arena.obstacles.cart.plan.speed=0.2", "arena.obstacles.post.at=[0.5, 0.5]"]).experiment.arena
    assert found.obstacles["cart"].plan == {"kind": "line", "move_by": [1.0, 0.0], "speed": 0.2}
    assert found.obstacles["post"].at == (0.5, 0.5)
    (tmp_path / "hall.toml").write_text("[arena]\nsize = [9.0, 9.0, 3.0]\n")
    assert read(file, ["arena.file=hall.toml", "arena.walls=false"]).experiment.arena.obstacles == {}
    assert refused(file, "arena.file=hal.toml")[0].file == "--set arena.file=hal.toml"
    (problem,) = refused(file, "arena.obstacles.cart.plan.radius=0.2")
    assert "no plan of this experiment has a parameter 'radius'" in problem.message


@pytest.mark.parametrize(
    ("arena", "place", "message", "hint"),
    [
        ("[arena]\nsize = [4.0, 3.0]\n", (2, 8), "'size' must be a list of length 3", ""),
        ("[arena]\nsiez = [4.0, 3.0, 2.0]\n", (2, 1), "unknown key 'siez' in 'arena'", "'size'"),
        ("size = [4.0, 3.0, 2.0]\n", (1, 1), "unknown key 'size'", ""),
        ("[arena]\n[robots.KH01]\nstart = [0.0, 0.0]\n", (2, 2), "unknown key 'robots'", "in the experiment file"),
        ("[arena]\nseed = 3\n", (2, 1), "unknown key 'seed' in 'arena'", "'seed' belongs in the experiment file"),
        ('[arena]\nfile = "hall.toml"\n', (2, 1), "an arena file cannot name another", ""),
        ("[arena]\n[arena.obstacles.a]\nradius = 0.1\nat = [9.0, 0.0]\n", (4, 6), "'a' stands outside", ""),
        ("", (0, 0), "is empty", ""),
        ("# nothing\n", (0, 0), "holds nothing but comments", ""),
    ],
)
def test_wrong_arena_file_is_refused_where_wrong(tmp_path, arena, place, message, hint):
    file = write_files(tmp_path, arena=arena)
    problem = refused(file)[0]
    assert problem.file == str(file.parent / "lab.toml")
    assert (problem.line, problem.column) == place
    assert message in problem.message
    assert hint in problem.hint


def test_conflicts_with_the_arena_point_into_both_files(tmp_path):
    small = ONE.replace('"lab.toml"\n', '"lab.toml"\nsize = [2.0, 3.0, 2.0]\n')
    robot, box = refused(write_files(tmp_path, small))
    assert (robot.file.rpartition("/")[2], robot.line) == ("one.toml", 8)
    assert (box.file.rpartition("/")[2], box.line) == ("lab.toml", 16)
    problem = refused(write_files(tmp_path, ONE + "[cases.small.arena]\nsize = [3.9, 1.0, 2.0]\n"))[0]
    assert (problem.file.rpartition("/")[2], problem.line) == ("one.toml", 8)
    assert problem.message.startswith("in case 'small', arena.obstacles.cart.at: 'cart' stands outside")


def test_catalogue_arena_files_are_no_experiments(tmp_path):
    assert not any("arena" in name for name in index.names())
    made = entries.copy_entry("obstacle-course", tmp_path)
    assert read(made).experiment == read("obstacle-course").experiment
    assert {file.name for file in tmp_path.iterdir()} == {made.name, "gate.arena.toml", index.SCHEMA}
    (tmp_path / "gate.arena.toml").write_text("[arena]\n")
    with pytest.raises(DocumentError, match="is another arena"):
        entries.copy_entry("obstacle-course", tmp_path / "again.toml")
    assert not (tmp_path / "again.toml").exists()


def test_arena_file_is_of_the_catalogue_or_beside(tmp_path):
    arena = read(write_files(tmp_path, ONE.replace("lab.toml", "gate.arena.toml"))).experiment.arena
    assert list(arena.obstacles) == ["left", "right"]
    for name in ("experiment.toml", "Experiment.TOML", "run.json", "event.mcap"):  # files of a run
        (tmp_path / name).write_text(LAB)
        with pytest.raises(DocumentError, match="call it otherwise"):
            read(write_files(tmp_path, ONE.replace("lab.toml", name)))
