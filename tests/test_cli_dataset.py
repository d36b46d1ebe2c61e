"""`nma dataset` reports its speed and how long it will take."""

from nma.cli.dataset import _span


def test_a_dataset_says_how_long_it_will_take(nma, tmp_path):
    code, _, err = nma("dataset", "layered3", tmp_path / "x.zarr", "--materials", 2, "--walks", 1600)
    assert code == 0
    assert "to go at" in err and "million walks per second" in err
    assert [_span(s) for s in (5, 300, 9000, 1e6)] == [
        "5 seconds",
        "5.0 minutes",
        "2.5 hours",
        "11.6 days",
    ]
