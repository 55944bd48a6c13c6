"""Experiments, benchmarks and generators; run them from the repository root as ``python -m scripts.NAME``."""
