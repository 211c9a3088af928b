"""Benchmarks that a reader can repeat: `python -m benchmarks VERB`."""
