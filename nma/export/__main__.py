"""Writes the generated files into `runtime/` of a checkout: python -m nma.export [FOLDER]."""

import sys
from pathlib import Path

from nma.export import FILES, printed
from nma.files import write_text

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "runtime")
for name in FILES:
    write_text(folder / name, printed(name))
    print(folder / name)
