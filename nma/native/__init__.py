"""Compiles the C++ runtime on the user's machine (`build`), and calls the C++ runtime from Python (`runtime`)."""
