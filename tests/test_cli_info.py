"""`nma info` shows the metadata of a weights file."""

from nma.adapter import DEFAULT_ADAPTER
from nma.cli import options


def test_info_says_that_the_training_loss_includes_noise_of_the_tables(nma):
    _, out, _ = nma("info", "layered3-principled-5x64")
    assert "log_loss_of_last_1000_steps  .01036" in out
    assert "includes the noise of the training tables" in " ".join(out.split())


def test_commands_use_the_default_adapter():
    """The commands have a constant of their own, because the import of `nma.adapter` would slow down `--help`."""
    assert options.DEFAULT_ADAPTER == DEFAULT_ADAPTER
