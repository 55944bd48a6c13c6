"""`tk sync`: what cameras recorded becomes a capture."""
