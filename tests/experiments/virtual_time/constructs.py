"""Every construct of the subset that is compiled: a function each, whose text is its row in docs/plugins.md.

Parameters are attributes of a `Case`, `case` is itself.
"""

import math
from enum import IntEnum
from math import atan2, floor, inf, isfinite, nan, pi, sqrt

FACTORS = (1.0, -2.0, nan, inf)
COUNTS = (3, (1, 2))


class Part:
    """An object with a tuple and a method."""

    GAIN = 0.5
    __slots__ = ("at", "size", "unused")

    def __init__(self, size):
        self.size, self.at, self.unused = size, (size, -size, 0.0), None

    def moved(self, by, *, twice=False):
        x, y, z = self.at
        self.at = (x + by, y, z + self.GAIN) if twice else (x, y + by, z)
        return self.at[1] - self.longest

    @property
    def longest(self):
        return max(self.at)


class Case:
    """Numbers and objects that a function is given."""

    def __init__(self, x, y, i, j):
        self.x, self.y, self.i, self.j, self.yes, self.nobody = x, y, i, j, x < y, None
        self.numbers, self.counts, self.empty = [x, y, 0.5], [i, j], []
        self.parts, self.part = [Part(1.0), Part(y)], Part(x)


class Colour(IntEnum):
    """Names of numbers."""

    RED, BLUE = 1, 5


def numbers(x, i, yes):
    """float, int (to ±2⁶¹), bool, which keep their type: `0.0`, never `0`, for a float"""
    z: float = x
    n, ok = i, yes
    return z, n, ok, -0.0, 7, True


def names_of_constants(x):
    """numbers and tuples of numbers of a module or a class; members of an `IntEnum`"""
    return FACTORS[0] * x, FACTORS[2], FACTORS[3], COUNTS[1][1], math.tau, pi, Part.GAIN, Colour.BLUE, -inf


def tuples(x, y, i):
    """a fixed number of values, taken apart again or by an index"""
    pose = (x, y, 0.5)
    (a, b, _), (n, (c,)) = pose, (i, (y,))
    a, b = b, a
    return a, b, c, n, pose[0], pose[-1], pose[i % 3], pose[i % 5]


def attributes(case, x):
    """of `self`, `link`, `view`, `pose`, `own`, `near`, and of objects that those have"""
    case.part.size = x + 1.0
    case.part.at, case.yes = (case.part.size, x, x), x > 0.0
    part = case.part
    part.size *= 2.0
    return case.part.size, case.part.at, case.yes


def lists(case, x, i):
    """of numbers, or of objects of one class, of a length that stays"""
    case.numbers[i % 3] = x
    case.numbers[-1] += 1.0
    case.parts[i % 2].size = x
    return case.numbers[i], case.numbers[0], len(case.numbers), case.parts[-1].size, case.counts[0], len(case.empty)


def nothing(case, x):
    """an attribute or a parameter that is always None, or never: asked by `is None`"""
    if case.nobody is not None:
        return case.nobody.size
    return x if case.part.unused is None else 0.0


def sums(x, y, i, j):
    """`+ - *` and signs, of floats and of ints"""
    return x + y, x - y, x * y, -x, +x, x * 2, i + x, i * j - i, i + j, -i, i - 3, True + i


def quotients(x, y, i, j):
    """`/ // %`"""
    return x / y, i / j, x % y, i % j, x // y, i // j, x / 3.0, i / 3


def powers(x, y, i):
    """`**`: of floats; of ints with a constant exponent"""
    return x**2, x**3.0, abs(x) ** y, i**2, i**3, i**0


def powers_of_anything(x, y):
    """as `powers`"""
    return x**y


def bits(i, j, x, y):
    r"""`& \| ^ ~ << >>`, of ints; the first three of bools, too"""
    return (
        i & j,
        i | j,
        i ^ j,
        ~i,
        i << 2,
        i >> 1,
        i << j,
        i >> j,
        (x < y) & (i < j),
        (x < y) | (i < j),
        1 << Colour.BLUE,
    )


def assignments(x, i):
    """`=`, `+=` and its like, with annotations or without, also several at once"""
    a = b = x
    a += 1.0
    b /= 2.0
    n: int = i
    n *= 3
    n -= 1
    n %= 7
    return a, b, n


def comparisons(x, y, i, j):
    """of numbers, also several in a row; `is` of objects"""
    return x < y, x <= y, x > y, x >= y, x == y, x != y, i < x, i == y, -1.0 < x <= 1.0, i < j < 3, x == 0


def objects_that_are_the_same(case):
    """as `comparisons`"""
    return case.part is case.part, case.part is not case.parts[0]


def logic(x, y, i, j, case):
    """`and`, `or`, `not`, which give one of their values, as Python does"""
    both = not ((x > y and i > j) or x == y)
    return x < 0.0 and y < 0.0, both, x or y, i and j, not i, bool(x), bool(case.empty or case.numbers), not case.empty


def what_is_not_computed(case, x, y, i):
    """as `logic`"""
    found = i < 0 or case.numbers[i] > 0.0, -3 <= i < 3 and case.numbers[i] > 0.0, x > 0.0 and sqrt(x) > y
    return found, (case.part.moved(x) if x > 0.0 else case.part.moved(y)), case.part.at[0]


def choices(x, y, i, j):
    """`a if b else c`"""
    return (x if x < y else y), (1.0 if i > j else x), (i if i > j else j), (x, y) if i else (y, x)


def branches(x, y, i):
    """`if`, `elif`, `else`; each sets a variable that is read later"""
    if x < y and i > 0:
        found = x
    elif x > y:
        found = y
        if i < 0:
            return -1.0, i
    else:
        found = 0.0
    return found, i


def loops_over_ranges(x, i, j):
    """`for` over a `range`, with `break` and `continue`"""
    total, n = 0.0, 0
    for k in range(abs(i)):
        if k == 3:
            continue
        if k > 6:
            break
        total += k * x
    for k in range(5, j, -2):
        n += k
        for m in range(k):
            n += m
    return total, n


def loops_over_lists(case, x):
    """`for` over a list or a tuple"""
    total = 0.0
    for part in case.parts:
        part.size += x
        total += part.size
    for number in case.numbers:
        total -= number
    for number in (x, 2.0, total):
        total *= number
    for part in case.empty:
        total = part.size
    return total


def loops_while(x, i, j):
    """`while`"""
    n, y = 0, x
    while n < j and y < 100.0:
        n += 1
        y += 0.5 * n
        if n * n > 30 + i:
            break
    while True:
        n += 2
        if n > 9:
            return n, y


def of_math(x, y):
    """`sqrt atan atan2 tanh fabs copysign degrees radians isfinite isinf isnan` of `math`, by either name"""
    angle = atan2(x, y), atan2(-0.0, y), math.atan(x), math.tanh(x)
    rest = (
        math.isinf(x),
        math.isnan(y),
        isfinite(x),
        math.copysign(x, y),
        math.fabs(y),
        math.degrees(x),
        math.radians(y),
    )
    return angle, rest, sqrt(math.fabs(x))


def of_math_with_limits(x):
    """`sin cos tan asin acos exp expm1 log log1p` of `math`"""
    if not -1.0 <= x <= 1.0:
        return math.sin(x), math.cos(x), math.tan(x), math.exp(x), math.expm1(x), math.log(x), math.log1p(x)
    return math.asin(x), math.acos(x), sqrt(x), 0.0, 0.0, 0.0, math.log1p(x)


def whole_parts(x, y, i):
    """`floor ceil trunc` of `math`, `int`, `round` without digits"""
    return floor(x), math.ceil(y), math.trunc(x), int(y), round(x), floor(i), int(i), round(i), int(x < y)


def of_python(x, y, i, j):
    """`min` and `max` of numbers of one type, `abs`, `len`, `float`, `bool`; `float("nan")`, `float("inf")`"""
    least = min(x, y), max(x, y), min(i, j), max(i, j), min((x, y, 0.0)), max(x, 0.0), min(max(x, -1.0), 1.0)
    unknown = float("nan"), -float("inf")
    return least, abs(x), abs(i), len((x, y)), float(i), float(x < y), bool(i), min(nan, x), max(x, nan), unknown


def words(x, i, j):
    """sums, products and bits of whole numbers modulo 2⁶⁴: `& 0xFFFFFFFFFFFFFFFF`; bits of those, and `>>`"""
    word = (i * ODD + j) & ALL
    other = ((word ^ (word >> 30)) * ODD + 7) & ALL
    return x * word, (other >> 11) * 0.5, ((other ^ word) | other) * 1.0, (word & other) * 2.0, (i & ALL) * 1.0


ODD, ALL = 0xBF58476D1CE4E5B9, 0xFFFFFFFFFFFFFFFF


def slices(x, y):
    """of tuples, with constant ends"""
    return (x, y, 0.5)[:2], (x, y, 0.5)[-2:], (x, y, 0.5)[::2]


def dictionaries(x, y, i):
    """with texts as keys, which no statement sets later; a text as an argument"""
    table = {"b": i, "a": (x, y)}
    return part(table, "a"), table["b"], part({"a": (y, 0.5)}, name="a")


def dictionaries_by_names(x, y):
    """comprehensions of, and loops over, the names of a table of constants; `dict`, `tuple(map(function, values))`"""
    table, total, name = {"b": (x,), "a": (y, 0.5)}, 0.0, 7.0
    made = {name: tuple(map(larger, table[name])) for name in METRES}
    for each in METRES:  # noqa: PLC0206 - a loop over pairs is outside of the subset
        for value in dict(made)[each]:
            total += value * METRES[each]
    return total, made["a"], made["b"], name


METRES = {"b": 2.0, "a": 0.1}


def larger(x):
    return 1.1 * x + 1.0


def part(table, name):
    return table[name][1] if name == "a" else table[name][0]


def comprehensions(case, x):
    """lists that are not kept, of ranges, lists, `zip` or `enumerate`, with `if`"""
    made, total, each = [each * x for each in case.numbers if each > 0.0], 0.0, 0.25
    pairs = [(a + 1.0, b) for a, b in zip(case.numbers, case.numbers, strict=True)]
    for more in made:
        total += more
    for a, b in pairs:
        total += a * b
    for k, size in enumerate(case.numbers):
        total += k * size
    return total, each, len(made), len([k + 1 for k in range(5, 0, -2)])


def generators(case, x):
    """within `any`, `all`, `sum` (of floats, Python 3.11), `min` and `max`; of a list, too"""
    least = min((each for each in case.numbers if each > x), default=9.0), max([x, *case.numbers])
    some = any(each > x for each in case.numbers), all(each > x for each in case.numbers)
    return least, some, sum(each * x for each in case.numbers), sum([x, 0.5]), max(each.size for each in case.parts)


def lengths(x, y):
    """`hypot` and `dist` of `math` (Python 3.11)"""
    return math.hypot(x, y), math.dist((x, y, 0.5), (y, 0.25, x)), math.hypot(x, 3.0, y)


def digits(x):
    """`float(f"{x:.7g}")`, of any number of digits"""
    return float(f"{x:.7g}"), float(f"{x:.{FIVE}g}")


FIVE = 5


def longer(a, b=2.0, *, of=1.0):
    return (a, b) if a > b else (b, a * of)


def calls(case, x, y):
    """functions and methods that are in the subset, with their defaults, and properties; not of themselves"""
    a, b = longer(x)
    return (
        a + longer(x, y, of=b)[1],
        longer(y, of=x)[0],
        case.part.moved(x),
        case.part.moved(by=y, twice=True),
        case.part.longest,
    )


def order_of_calls(case, x):
    """as `calls`"""
    return case.part.at[1] + case.part.moved(x) * case.part.at[1], case.part.size - case.part.moved(1.0) - case.part.at[
        1
    ]


def errors(x, i, case):
    """`raise` and `assert`, errors of arithmetic and of indices: those ticks are then flown in Python"""
    if x < -2.0:
        raise ValueError(f"too small: {x}")
    assert i > -9, "never"
    return case.numbers[i], sqrt(x), 1.0 / i


CONSTRUCTS = [
    each
    for each in list(globals().values())
    if hasattr(each, "__code__") and each.__module__ == __name__ and each.__doc__
]
ROWS = [
    f"| {each.__name__.replace('_', ' ')} | {each.__doc__} |"
    for each in CONSTRUCTS
    if not each.__doc__.startswith("as `")
]
