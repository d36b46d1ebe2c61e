"""Writes the generated files into `runtime/` of a checkout: python -m nma.export [FOLDER]."""

import sys
from pathlib import Path

from nma.export.classes import classes
from nma.export.cpp import cpp

FILES = {"nma/target.h": cpp, "nma/classes.h": classes}

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "runtime")
for name, generate in FILES.items():
    (folder / name).write_text(generate())
    print(folder / name)
