"""Compiles the C++ runtime (`build`) and calls it from Python (`runtime`)."""
