"""Python's garbage collector destroys no BSDF while Dr.Jit records.

In every picture, Dr.Jit calls all BSDFs in memory. Among them are the BSDFs of a scene that nobody needs any more, but
that is in a reference cycle, so that only the garbage collector frees it. An exception that keeps its traceback makes
such a cycle, for example. Our BSDFs are written in Python, so their calls can start the garbage collector, which may
destroy the very BSDF that Dr.Jit is calling. Then the process crashes when this BSDF's C++ code continues.
"""

from __future__ import annotations

import gc

_spared = False
# Whether a collection was started during a recording, and so freed nothing.
_postponed = False


def spare_recordings() -> None:
    """From now on, the garbage collector frees nothing while its thread records. Further calls do nothing."""
    from nma.jit import dr

    global _spared
    if _spared:
        return
    _spared = True
    recording = False

    def on_collection(phase: str, info: dict[str, int]) -> None:
        # Python calls this function before and after every collection. The function cannot refuse a collection, but
        # gc.freeze hides all objects from the collection.
        global _postponed
        nonlocal recording
        if phase == "start":
            recording = dr.flag(dr.JitFlag.SymbolicScope)
            if recording:
                _postponed = True
                gc.freeze()
        elif recording:
            gc.unfreeze()

    gc.callbacks.append(on_collection)


def collect_postponed() -> None:
    """Frees old scenes that are in reference cycles, if a recording has postponed this.

    gc.unfreeze marks all objects as old, and Python rarely frees old objects by itself.
    """
    global _postponed
    if _postponed:
        _postponed = False
        gc.collect()
