"""Measures the errors of adapters against tables, and of sources against each other."""

from nma.evaluate.adapters import Evaluation, evaluate, table_log_loss, tabulate_adapter

__all__ = ["Evaluation", "evaluate", "table_log_loss", "tabulate_adapter"]
