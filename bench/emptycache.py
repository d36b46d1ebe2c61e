"""Import this before Dr.Jit: its cache of kernels is empty then, and compilation takes its time."""

import os
import sys
import tempfile

assert "drjit" not in sys.modules, "import bench.emptycache first"
_FOLDER = tempfile.TemporaryDirectory()
os.environ["DRJIT_CACHE_DIR"] = _FOLDER.name
