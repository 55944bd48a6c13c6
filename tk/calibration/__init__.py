"""Calibrate cameras with a printed board: `tk calibrate BOARDS`."""
