"""Many captures, one after the other or on many machines: `tk batch`."""

from __future__ import annotations

from tk.batch.jobs import Job, Outcome, TrackOptions
from tk.batch.run import BatchReporter, exit_code, run_batch

__all__ = ["BatchReporter", "Job", "Outcome", "TrackOptions", "exit_code", "run_batch"]
