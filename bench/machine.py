"""What every benchmark prints first: the machine, its load, and the command."""

from __future__ import annotations

import os
import platform
import shlex
import sys
from pathlib import Path


def header() -> str:
    """Machine, cores, load average, Python and command, one per line."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = [
            line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line
        ]
        model = lines[0] if lines else model
    load = "{:.2f} {:.2f} {:.2f}".format(*os.getloadavg())
    return (
        f"machine  {model}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}\n"
        f"load     {load}\n"
        f"python   {platform.python_version()}\n"
        f"command  {shlex.join([Path(sys.executable).name, *sys.argv])}"
    )
