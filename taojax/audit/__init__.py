"""The judge: truth, labels, thresholds, metrics and the report; runs after the seal."""
