"""Checks of a capture before tracking."""
