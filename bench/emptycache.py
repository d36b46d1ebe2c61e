"""Gives Dr.Jit an empty kernel cache, so that every kernel is compiled. Import this module before Dr.Jit."""

import os
import sys
import tempfile

assert "drjit" not in sys.modules, "import bench.emptycache before drjit"
_FOLDER = tempfile.TemporaryDirectory()
os.environ["DRJIT_CACHE_DIR"] = _FOLDER.name
