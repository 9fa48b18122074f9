"""Parameters and log variables of a real firmware, where this machine has them: names and types only."""

import json
from pathlib import Path

PLACES = [folder / "shared" / "prototypes" / "crazyflie-toc.json" for folder in Path(__file__).parents[3:]]
FIRMWARE = next(filter(Path.exists, PLACES), PLACES[0])
CTYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "i8": "int8_t", "i16": "int16_t", "i32": "int32_t"}


def cached(folder):
    """Writes both tables as cflib writes them to its cache; returns the files."""
    parameters, logs = json.loads(FIRMWARE.read_text())
    tables = {
        "ParamTocElement": {name: (kind, {"access": int(fixed), "extended": kept})
                            for name, (kind, fixed, kept) in parameters.items()},
        "LogTocElement": {name: (kind, {"access": 0}) for name, kind in logs.items()},
    }  # fmt: skip
    files = []
    for element, entries in tables.items():
        table = {}
        for ident, (name, (kind, rest)) in enumerate(entries.items()):
            group, own = name.split(".")
            entry = {"__class__": element, "ident": ident, "group": group, "name": own, "pytype": ""}
            table.setdefault(group, {})[own] = entry | {"ctype": CTYPES.get(kind, kind)} | rest
        files.append(str(folder / f"{element}.json"))
        Path(files[-1]).write_text(json.dumps(table))
    return files
