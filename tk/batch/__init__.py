"""Many captures, on one or several machines: `tk batch`."""

from __future__ import annotations

from tk.batch.jobs import Job, Outcome
from tk.batch.run import BatchReporter, exit_code, run_batch

__all__ = ["BatchReporter", "Job", "Outcome", "exit_code", "run_batch"]
