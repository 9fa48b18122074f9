"""Figures in a notebook, and in a script that opens as one.

from experiments.notebook import show
show(run.figures()["errors"], "figures/errors")     # the last line of a cell: shown below it, and kept as a file
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from experiments import drawing

CHECKOUT: Final = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Picture:
    """A figure that shows itself below a cell; `files` are where it is kept, SVG and PDF."""

    figure: Figure
    files: tuple[Path, ...] = ()

    def _repr_svg_(self) -> str:
        """What notebooks ask for. The figures are drawn without pyplot, by which notebooks would find them."""
        return drawing.svg(self.figure)


def show(figure: Figure, file: str | Path | None = None) -> Picture:
    """A figure for the end of a cell.

    Args:
        figure: Any of matplotlib's.
        file: Where to keep it, as SVG and PDF; without a suffix.
    """
    if file is None:
        return Picture(figure)
    return Picture(figure, drawing.save(figure, Path(file).parent, Path(file).name))


def folder(default: str) -> Path:
    """Where a script keeps its figures: its first argument; `default` if there is none, and in a notebook.

    Args:
        default: From the checkout, wherever the script or the notebook was started.
    """
    given = [] if "ipykernel" in sys.modules else sys.argv[1:]  # a kernel's arguments are its own
    return Path(given[0]) if given else CHECKOUT / default
