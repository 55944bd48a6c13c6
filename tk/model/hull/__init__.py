"""The visual hull."""
