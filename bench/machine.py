"""The header that every bench prints first: the machine, its load, and the command."""

from __future__ import annotations

import os
import platform
import re
import shlex
import sys
from pathlib import Path


def header() -> str:
    """Returns lines of text: the processor and its number of cores, the load average, Python's version, the command."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        # Virtual machines often hide the processor's name, so the processor's family is shown too. AMD's family 25 is
        # Zen 3 or Zen 4, and AMD's family 26 is Zen 5.
        fields = dict(re.findall(r"^(.*?)\s*: (.*)$", cpuinfo.read_text(), re.MULTILINE))
        names = [
            fields.get("model name"),
            *(f"{n} {fields[n]}" for n in ("cpu family", "model") if n in fields),
        ]
        model = ", ".join(name for name in names if name) or model
    main = sys.modules["__main__"].__spec__
    program = ["-m", main.name] if main else sys.argv[:1]
    load = "{:.2f} {:.2f} {:.2f}".format(*os.getloadavg())
    return (
        f"machine  {model}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}\n"
        f"load     {load}\n"
        f"python   {platform.python_version()}\n"
        f"command  {shlex.join([Path(sys.executable).name, *program, *sys.argv[1:]])}"
    )
