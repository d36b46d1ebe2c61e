"""`nma info` shows what a weights file says about itself."""


def test_the_loss_of_training_is_told_from_the_error_of_the_adapter(nma):
    _, out, _ = nma("info", "layered3-5x64")
    assert "log_loss_of_last_1000_steps  .01036" in out
    assert "holds their noise too" in " ".join(out.split())
