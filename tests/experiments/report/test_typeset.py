from __future__ import annotations

from experiments.report.page import Row, Table
from experiments.report.typeset import latex, markdown

TABLE = Table(
    ("Robot", "IAE [m s]"), (Row((("KH_1", "khepera4"), "1 ± 2")), Row(("mean", "−3"), sum=True)), title="a|b"
)


def test_latex_is_a_booktabs_table_with_signs_escaped():
    assert latex([TABLE, Table(("empty",), ())]).splitlines() == [
        r"\begin{table}",
        r"\centering\footnotesize\setlength{\tabcolsep}{3pt}",
        r"\caption{Robots, a|b.}",
        r"\label{tab:robots-a-b}",
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"Robot & IAE [m s] \\",
        r"\midrule",
        r"KH\_1 khepera4 & 1 $\pm$ 2 \\",
        r"\midrule",
        r"mean & $-$3 \\",
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]


def test_a_wide_table_fits_a_column():
    ratios = Row(("IAE [m s]", "4.100 ± 0.005", ("4.42 ± 0.01", "× 1.078 ± 0.004"), ("4.50 ± 0.01", "× 1.100 ± 0.004")))
    below = latex([Table(("Mean per robot", "a", "b", "c"), (ratios,))])
    assert r" &  & $\times$ 1.078 $\pm$ 0.004 & $\times$ 1.100 $\pm$ 0.004 \\" in below.splitlines()
    many = Table(("Robot", *(f"column {k}" for k in range(9))), (Row(("tb2", *("1.00",) * 9)),))
    split = latex([many])
    assert (split.count(r"\begin{tabular}"), split.count(r"\begin{table}"), split.count("tb2")) == (2, 1, 2)
    wide = latex([many], width=7.16)
    assert (wide.count(r"\begin{tabular}"), wide.count(r"\begin{table*}")) == (1, 1)


def test_signs_of_users_and_heads_in_lines_are_safe_in_latex():
    table = Table(
        ("[m] a_b", "minimum_interval_s"), (Row(("50 % & #1_~^\\", "0.1")),), title="{σ} $λ → x", note="α ± β"
    )
    text = latex([table], width=1.0)
    assert r"{}[m] a\_b & \shortstack[r]{minimum\_\\interval\_s} \\" in text.splitlines()
    assert r"50 \% \& \#1\_\textasciitilde{}\textasciicircum{}\textbackslash{} & 0.1 \\" in text.splitlines()
    assert r"\caption{{}[m] a\_bs, \{$\sigma$\} \$$\lambda$ $\to$ x. $\alpha$ $\pm$ $\beta$}" in text.splitlines()
    units = latex([Table(("Robot", "Acquired [s]"), (Row(("K1", "6.22")),))], width=0.5)
    assert r"\shortstack[r]{Acquired\\{}[s]}" in units  # a bracket behind a break would be a length
    assert units.isascii()


def test_a_high_table_goes_over_several_floats_and_repeats_the_names_of_its_rows():
    rows = tuple(Row(("event", f"{k}", "0.0491 ± 0.0003", "1.104 ± 0.006", "1.40 ± 0.01")) for k in range(40))
    head = ("Case", "threshold", "messages ratio", "IAE ratio", "ITAE ratio")
    text = latex([Table(head, rows, title="T", keys=2)], width=2.0)
    assert text.count(r"\begin{table}") == text.count(r"\begin{tabular}") == 3
    assert text.count("event & 7 & ") == 3
    assert (text.count(r"\label{tab:cases-t}"), text.count(r"\label{tab:cases-t-2}")) == (1, 1)
    assert text.count(", continued.") == 2


def test_markdown_is_a_pipe_table():
    assert markdown([TABLE]).splitlines() == [
        "**a|b**",
        "",
        "| Robot | IAE [m s] |",
        "|---|---:|",
        r"| KH\_1 khepera4 | 1 ± 2 |",
        "| mean | −3 |",
    ]
