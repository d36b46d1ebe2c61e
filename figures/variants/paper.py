"""The results of the paper's Table 2 (89 materials) and Table 3 (92 materials), for comparison with our results."""

from __future__ import annotations

from nma.images.metrics import METRICS


def _rows(text: str) -> dict[str, dict[str, float]]:
    """Parses lines of the form `name: value ...`, with one value for each metric, in the order of `METRICS`."""
    lines = (line.split(":") for line in text.strip().splitlines())
    return {
        name.strip(): dict(zip(METRICS, map(float, numbers.split()), strict=True)) for name, numbers in lines
    }


# MAPE and SMAPE are in percent, as in the paper. The paper's Table 3 has no row for five instances.
TABLE_2 = _rows("""
    single:            .0055 .0003 2.6285 2.5006 .0124 .9954 .0484 .0387
    omega_i:           .0051 .0002 2.5037 2.3927 .0106 .9961 .0453 .0367
    blended:           .0053 .0003 2.4593 2.3516 .0114 .9957 .0454 .0368
    blended + omega_i: .0050 .0002 2.3876 2.2867 .0103 .9963 .0432 .0352
""")
TABLE_3 = _rows("""
    1 instance:  .01072 .000478 4.921 4.696 .0059 .9587 .0707 .0505
    2 instances: .01007 .000341 4.674 4.455 .0050 .9593 .0657 .0467
    3 instances: .01101 .000436 5.192 4.852 .0068 .9610 .0712 .0502
    4 instances: .01004 .000384 4.723 4.486 .0056 .9586 .0666 .0465
""")
PERCENT = ("mape", "smape")
