"""The C++ runtime from Python: what compiles it, and what calls it."""
