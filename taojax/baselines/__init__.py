"""Rival systems on equal inputs, with the same output columns."""
