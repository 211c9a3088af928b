"""Mathematics: pure JAX functions of one branch and one frame, no files."""
