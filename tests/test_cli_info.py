"""`nma info` shows the metadata of a weights file."""


def test_info_says_that_the_training_loss_includes_noise_of_the_tables(nma):
    _, out, _ = nma("info", "layered3-5x64")
    assert "log_loss_of_last_1000_steps  .01036" in out
    assert "includes the noise of the training tables" in " ".join(out.split())
