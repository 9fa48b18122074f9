"""Measure everything again, and put the tables into `docs/results/peers.md`.

python -m docs.bench            # an hour, and 7 GB in the user's cache
"""

import re
import time
from pathlib import Path

from docs.bench import growth, peers
from experiments.recording.version import DIGEST_CHARACTERS, provenance

PAGE = Path(__file__).resolve().parents[1] / "results" / "peers.md"


def renewed(page, tables):
    """A page with other text between `<!-- NAME -->` and `<!-- end -->`, by name.

    Raises ValueError if it has no such place.
    """
    for name, text in tables.items():
        place = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end -->)", re.DOTALL)
        if not place.search(page):
            raise ValueError(f"no place for {name!r}")
        page = place.sub(lambda found, text=text: f"{found[1]}\n{text}\n{found[2]}", page)
    return page


def main():
    here, day = provenance(), time.strftime("%Y-%m-%d")
    memory = f"{here.cores} cores, {here.memory_gb:.0f} GB, other work on them: load {here.load}"
    where = f"Commit {here.commit[:DIGEST_CHARACTERS]}, {day}; {here.cpu}, {memory}; Python {here.python}."
    tables = {"peers": peers.report([*peers.OTHERS, peers.ZENOH]), "growth": growth.report()}
    page = renewed(PAGE.read_text("utf-8"), {"circumstances": where, **tables})
    PAGE.write_text(page, encoding="utf-8")
    print(page)


if __name__ == "__main__":
    main()
