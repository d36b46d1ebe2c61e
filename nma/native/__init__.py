"""The C++ runtime from Python: `build` compiles it, `runtime` calls it."""
