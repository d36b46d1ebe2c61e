"""Writes the generated files into `runtime/` of a checkout: python -m nma.export [FOLDER]."""

import sys
from pathlib import Path

from nma.errors import NmaError
from nma.export import FILES, printed
from nma.files import into_pipe, write_text

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "runtime")
try:
    contents = {name: printed(name) for name in FILES}
    for name, content in contents.items():
        write_text(folder / name, content)
except NmaError as error:
    sys.exit(f"nma.export: {error}")
with into_pipe():
    for name in contents:
        print(folder / name)
